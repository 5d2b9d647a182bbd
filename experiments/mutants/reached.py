"""A plugin of pytest: writes which functions of the packages a run enters."""

import json
import os
import pathlib
import sys
import threading
import types

from experiments.mutants.faults import PACKAGES, ROOT

_codes: set[types.CodeType] = set()


def _note(frame, _event, _argument):
    _codes.add(frame.f_code)  # no local tracer comes back: lines are not told


def pytest_configure():
    """Note every function that is entered from now on."""
    threading.settrace(_note)
    sys.settrace(_note)


def pytest_unconfigure():
    """Write those of the packages as "file:line" of where they begin."""
    sys.settrace(None)
    threading.settrace(None)
    functions = set()
    for code in _codes:
        path = pathlib.Path(code.co_filename)
        if path.is_relative_to(ROOT) and path.relative_to(ROOT).parts[0] in PACKAGES:
            functions.add(f"{path.relative_to(ROOT)}:{code.co_firstlineno}")
    answer = pathlib.Path(os.environ["MUTANTS_REACHED"])
    answer.write_text(json.dumps(sorted(functions)))
