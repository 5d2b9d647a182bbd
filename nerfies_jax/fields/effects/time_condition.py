"""T-NeRF: a template that reads the time, without a warp.

It is the baseline of D-NeRF (Pumarola et al. 2020, arXiv:2011.13961, a network of
position, direction and time) and of DyCheck (Gao et al. 2022, arXiv:2210.13445, with a
code of the frame instead of the time). On the monocular captures of DyCheck its PSNR is
higher than that of Nerfies. It provides no correspondence between times.
"""

import dataclasses

from jaxtyping import Array, Float

from nerfies_jax.nn import encoding
from nerfies_jax.nn.encoding import EncodingSpec
from nerfies_jax.training.effects import TIMESTAMP, FrameCondition, Table, Vector

CONDITIONS = ("time", "code")


@dataclasses.dataclass(frozen=True)
class TimeSpec:
    """Settings of the time features that the template reads.

    `condition="time"` is the time in [0, 1], encoded by `encoding`. "code" is the code
    of the frame from the table `table`, which warps may share.
    """

    encoding: EncodingSpec = EncodingSpec(4)
    condition: str = "time"
    table: str = "motion"
    code_width: int = 8

    name = "time"
    target = "trunk"

    def __post_init__(self):
        if self.condition not in CONDITIONS:
            raise ValueError(
                f"unknown condition {self.condition!r} of a template in time; choose "
                f"from {CONDITIONS}"
            )
        if self.code_width < 1:
            raise ValueError(
                f"code_width={self.code_width} must be at least 1; with 0 all frames "
                "would be equal"
            )

    @property
    def features(self) -> int:
        """Number of additional features that the trunk reads."""
        by_code = self.condition == "code"
        return self.code_width if by_code else self.encoding.width(1)

    @property
    def tables(self) -> tuple[Table, ...]:
        """Tables of the codes that it reads."""
        if self.condition != "code":
            return ()
        return (Table(self.table, TIMESTAMP, self.code_width),)

    def apply(
        self, params: None, point: Vector | None, frame: FrameCondition
    ) -> Float[Array, " features"]:
        """Compute the features of a frame, which are the same at all points."""
        return features(self, frame)


def features(spec: TimeSpec, condition: FrameCondition) -> Float[Array, " features"]:
    """Return the encoded time, or the code of the frame.

    Args:
      spec: Settings.
      condition: Conditioning of the frame.

    Returns:
      Features, [features].
    """
    if spec.condition == "code":
        return condition.codes[spec.table]
    return encoding.encode(spec.encoding, condition.time[None], None)
