"""Budget of the runs of an ablation, in steps or seconds."""

import math
import pathlib
from typing import NamedTuple

from experiments.ablate.results import ArmResult


class Budget(NamedTuple):
    """Duration of every run, and the folder of its results."""

    steps: int | None  # without seconds: None for the preset's own
    seconds: float | None
    folder: pathlib.Path
    clock: str = "wall"  # whose seconds

    @property
    def title(self) -> str:
        """The budget in words, as in "each arm trained ..."."""
        if self.seconds is not None:
            whose = "processor seconds" if self.clock == "processor" else "s"
            return f"for {self.seconds:g} {whose}, in as many steps as that allows"
        if self.steps is None:
            return "over its preset's own steps"
        return f"over {self.steps} steps"

    @property
    def measure(self) -> str:
        """Name of the measure that the seconds limit."""
        return "train_cpu_seconds" if self.clock == "processor" else "train_seconds"


def affordable(
    kept: ArmResult, budget: Budget, shorter: ArmResult | None = None
) -> int:
    """Steps that take the seconds of a budget, from what one run took, or two.

    Longer runs grow more Gaussians: between two runs the time is a power of the steps.
    """
    done, took = max(kept.notes["steps"], 1), kept.numbers[budget.measure]
    power = 1.0
    if shorter is not None:
        before, earlier = shorter.notes["steps"], shorter.numbers[budget.measure]
        if before != done and earlier > 0:
            power = math.log(took / earlier) / math.log(done / before)
    assert budget.seconds is not None
    # Outside it is the machine's other work that was timed.
    power = min(max(power, 1.0), 2.0)
    return max(1, round(done * (budget.seconds / took) ** (1 / power)))
