"""Settings of the initialization of motion: from point tracks, or static."""

import dataclasses
import math

STARTS = ("tracks", "none")
# In the form `path.to.field=value` of `specs.override`.
FROM_TRACKS, FROM_REST = "start.motion=tracks", "start.motion=none"


@dataclasses.dataclass(frozen=True)
class TrackStartSpec:
    """Settings of the initialization of motion.

    `motion` "tracks" fits the motion to point tracks before training if the video
    allows it, and "none" starts from a static scene. `use_depths` lets paths use the
    capture's depths.
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
        if not 0 < self.fit_rate < math.inf:
            raise ValueError(f"fit_rate={self.fit_rate} must be positive and finite")


@dataclasses.dataclass(frozen=True)
class FieldStartSpec(TrackStartSpec):
    """Settings of the initialization of the motion of a radiance field.

    A warp that was fitted to tracks, or a scene flow with a trunk of its own, starts
    with `first_rate` times its learning rate, which grows log-linearly to the full rate
    at the end of training. A template that is still blurred gives no information on
    positions, and led the warp back to a static scene.
    """

    # Built-in scene, 900 steps of `nerfies-grid-small`, one seed: where it moves and
    # end-point error of points, from 1: 17.2 dB, 0.0233 (0.0233 where nothing moves);
    # 0.1 throughout: 22.4, 0.0097; 0: 22.8, 0.0097; 0.01 to 1: 23.4, 0.0085.
    first_rate: float = 0.01

    def __post_init__(self):
        super().__post_init__()
        if not 0 < self.first_rate <= 1:
            raise ValueError(
                f"start.first_rate={self.first_rate} must be a share of the warp's "
                "learning rate, above 0 and at most 1"
            )
