"""How a scene that moves starts: from tracks of the pictures, or from rest."""

import dataclasses

STARTS = ("tracks", "none")


@dataclasses.dataclass(frozen=True)
class TrackStartSpec:
    """How a scene that moves starts.

    `motion` "tracks" fits the motion to tracks before training, where the film allows
    it; "none" starts from rest. `use_depths` lets paths lean on the capture's depths.
    """

    motion: str = "none"
    fit_steps: int = 1500
    fit_rate: float = 3e-3
    use_depths: bool = False

    def __post_init__(self):
        if self.motion not in STARTS:
            raise ValueError(f"unknown motion {self.motion!r}; choose from {STARTS}")
        if self.fit_steps < 1:
            raise ValueError(
                f"a start from tracks takes at least one step, got fit_steps="
                f"{self.fit_steps}"
            )
        if not self.fit_rate > 0:
            raise ValueError(f"fit_rate={self.fit_rate} must be positive")
