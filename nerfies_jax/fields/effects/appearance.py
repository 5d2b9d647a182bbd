"""Learned appearance code for each exposure, on which color depends but not density.

NeRF-W (Martin-Brualla et al. 2021, arXiv:2008.02268, "latent appearance modeling") has
a code (GLO, Bojanowski et al. 2018) for light, exposure and white balance of each
photograph, and so does Nerfies (Park et al. 2021, arXiv:2011.12948, section 3.1). The
geometry is the same for all codes, because only the color branch reads them.

In the official Nerfies code the codes have no effect. Its color branch depends on
another switch, and with the published presets their gradient is exactly zero.
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
                f"an appearance code needs width >= 1, got width={self.width}; set the "
                "effect to none for no codes"
            )

    @property
    def features(self) -> int:
        """Number of additional features that the color branch reads."""
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
