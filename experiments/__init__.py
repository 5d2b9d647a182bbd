"""Commands, benchmarks and checks: `nerfies NAME`, or `python -m experiments.NAME`."""

import os
import sys


def _leave_current_folder() -> None:
    """Take the current folder off the path, where `python -m experiments` put it first.

    A run folder from a stranger may be current and hold a `numpy.py`. The folder stays
    if this package was found in it, as in a checkout.
    """
    by_name = any(
        word.removeprefix("-m").partition(".")[0] == "experiments"
        for word in sys.orig_argv
    )
    # While runpy looks for the module, argv[0] is "-m", and "-c" in no case.
    if sys.argv[:1] != ["-m"] or not by_name or sys.flags.safe_path:
        return
    home = os.path.dirname(os.path.dirname(os.path.realpath(__file__)))
    if os.path.realpath(sys.path[0]) != home:
        del sys.path[0]


_leave_current_folder()
# Before NumPy is imported. Its matrices are small here: more threads than one wait in
# busy loops for each other, which takes twice the processor time of preprocessing, and
# on a busy machine twice the time.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# Found without the current folder.
from nerfies_jax.runtime import children, console, stopping  # noqa: E402

# Before anything else can open a file under the number of a closed stream.
console.open_descriptors()
children.end_with_parent()
# Before anything else is imported, which takes seconds.
stopping.install_for_program(__name__, "nerfies")
