"""The programs of the documentation run as they stand on their pages."""

import pathlib
import re

import jax
import pytest

DOCS = pathlib.Path(__file__).resolve().parents[1] / "docs"
LONGER = ("rasterization", "se3_warp", "volume_rendering", "fit_tracks")
PAGES = ("kan_layer", *(pytest.param(x, marks=pytest.mark.slow) for x in LONGER))


@pytest.mark.parametrize("page", PAGES)
def test_a_program_of_the_documentation_runs(page):
    text = (DOCS / f"{page}.md").read_text()
    blocks = re.findall(r"^```python\n(.*?)^```", text, re.M | re.S)
    assert len(blocks) > 1
    code = compile("\n".join(blocks), f"docs/{page}.md", "exec")
    # As users run them: optax promotes an integer count of steps.
    with jax.numpy_dtype_promotion("standard"):
        exec(code, {"__name__": page})
