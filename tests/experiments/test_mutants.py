"""Faults planted in the source: where, and what they become."""

from experiments.mutants import faults

SOURCE = '''
LIMIT = 3

def f(x, y, *, most=4):
    """Not -x here."""
    if x < LIMIT and most:
        raise ValueError(f"{x + 1}")
    return g(-x, 2 * y)
'''


def test_faults_stand_in_bodies_and_neither_in_words_nor_in_settings():
    planted = set()
    for fault in faults.places("a.py", SOURCE):
        wrong = SOURCE[: fault.start] + fault.text + SOURCE[fault.end :]
        compile(wrong, "a.py", "exec")
        planted.add(wrong.splitlines()[fault.line - 1].strip())
    assert planted == {
        "if x >= LIMIT and most:",
        "if x < LIMIT or most:",
        "return g(x, 2 * y)",
        "return g(-x, 2 / y)",
        "return g(-x, 3 * y)",
        "return g(2 * y, -x)",
    }


def test_the_modules_take_turns():
    sample = faults.sample_faults(8, seed=1, only="nerfies_jax/geometry")
    assert len({fault.path for fault in sample}) == 8
    assert sample == faults.sample_faults(8, seed=1, only="nerfies_jax/geometry")
