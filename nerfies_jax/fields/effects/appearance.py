"""Learned appearance code for each exposure, which color reads and density does not.

NeRF-W (Martin-Brualla et al. 2021, arXiv:2008.02268, "latent appearance modeling")
gives each photograph a code (GLO, Bojanowski et al. 2018) for light, exposure and white
balance. Nerfies (Park et al. 2021, arXiv:2011.12948, section 3.1) uses it too. Geometry
is the same under all codes, because only the color branch gets them.

In the official Nerfies code the codes have no effect: its color branch asks for another
switch, and under the published presets their gradient is exactly zero.
"""

import dataclasses

from jaxtyping import Array, Float

from nerfies_jax.training.effects import APPEARANCE, FrameCondition, Table, Vector


@dataclasses.dataclass(frozen=True)
class AppearanceSpec:
    """Settings of the appearance codes, of width 8 in Nerfies and 48 in NeRF-W.

    `table` is the name of their table.
    """

    width: int = 8
    table: str = "appearance"

    name = "appearance"
    target = "color"

    def __post_init__(self):
        if self.width < 1:
            raise ValueError(
                f"an appearance code needs width >= 1, got width={self.width}; without "
                "codes, set the effect to none"
            )

    @property
    def features(self) -> int:
        """Number of features that the color branch reads in addition."""
        return self.width

    @property
    def tables(self) -> tuple[Table, ...]:
        """Table of the codes."""
        return (Table(self.table, APPEARANCE, self.width),)

    def apply(
        self, params: None, point: Vector | None, frame: FrameCondition
    ) -> Float[Array, " features"]:
        """Return the code of the frame's exposure."""
        return frame.codes[self.table]
