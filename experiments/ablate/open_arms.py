"""What the papers leave open, or say without a table; no JAX."""

from experiments.ablate.arms import MOVING, Arm, Claim, Suite
from nerfies_jax.training.track_start import FROM_TRACKS

RANDOM = "init.source=random"
# What Sonata leaves open, from E-D3DGS, whose numbers the paper-size preset has.
FILLED = (
    *("batch_size=2", "dssim_weight=0.0", "motion.coarser=5"),
    *("motion.smoothness=1e-4", "motion.opacity=1e-4", "motion.grow_until=240"),
)

OPEN = Suite(
    arms={
        "points": Arm("moba-small", (FROM_TRACKS,)),
        "random": Arm("moba-small", (FROM_TRACKS, RANDOM)),
        "points-from-rest": Arm("moba-small"),
        "random-from-rest": Arm("moba-small", (RANDOM,)),
        "sonata": Arm("sonata-small", (FROM_TRACKS,)),
        "sonata-filled": Arm("sonata-small", (FROM_TRACKS, *FILLED), share=0.6),
    },
    claims=(
        Claim(
            "Random points serve MoBa-GS better than those of structure from motion "
            "(from tracks)",
            "random",
            "points",
            MOVING,
        ),
        Claim(
            "Random points serve MoBa-GS better than those of structure from motion "
            "(from rest)",
            "random-from-rest",
            "points-from-rest",
            MOVING,
        ),
        Claim(
            "What Sonata leaves open is better filled as in E-D3DGS",
            "sonata-filled",
            "sonata",
            MOVING,
        ),
    ),
    seeds=3,
    pictured=("points", "random", "random-from-rest", "sonata", "sonata-filled"),
    context=(
        "MoBa-GS says that it needs no points of structure from motion. Sonata leaves\n"
        "open how many views a step has, how many networks there are, and two\n"
        "penalties. Neither paper has an ablation of it. Two views a step take more\n"
        "time: `sonata-filled` makes 0.6 of the others' steps."
    ),
)

CODED = (*MOVING, "coded_mb")

RATE = Suite(
    arms={
        "no-law": Arm("adc-gs-small", (FROM_TRACKS, "motion.rate=none")),
        **{
            f"bits-at-{weight}": Arm(
                "adc-gs-small", (FROM_TRACKS, f"motion.rate.weight={weight}")
            )
            for weight in ("1e-3", "1e-2", "1e-1")
        },
    },
    claims=(
        Claim(
            "Features coded under a learned law take less and cost no quality",
            "bits-at-1e-3",
            "no-law",
            CODED,
        ),
        *(
            Claim(
                f"Bits are better dearer by {times}",
                f"bits-at-{weight}",
                "bits-at-1e-3",
                CODED,
            )
            for times, weight in (("ten", "1e-2"), ("a hundred", "1e-1"))
        ),
    ),
    seeds=3,
    pictured=("no-law", "bits-at-1e-3", "bits-at-1e-1"),
    context=(
        "The weight is that of the mean bits of a number of the features in ADC-GS'\n"
        "loss: the preset has 1e-3. With `no-law` there are neither rounding nor bits."
    ),
)

# Strong, and not robust: of the presets' own elastic penalty no arm shows an effect.
FIRM = (FROM_TRACKS, "elastic.weight=0.1", "elastic.robust_width=none")

LAZY = Suite(
    arms={
        "each-step": Arm("nerfies-grid-small", (*FIRM, "elastic.every=1")),
        "lazy": Arm("nerfies-grid-small", (*FIRM, "elastic.every=5")),
        "no-elastic": Arm("nerfies-grid-small", (FROM_TRACKS, "elastic=none")),
    },
    claims=(
        Claim(
            "An elastic penalty of each step stiffens more than one of each fifth",
            "each-step",
            "lazy",
            (*MOVING, "strain"),
        ),
        Claim(
            "One of each fifth step, five times as strong, stiffens what moves",
            "lazy",
            "no-elastic",
            (*MOVING, "strain"),
        ),
    ),
    seeds=3,
    pictured=("no-elastic", "each-step", "lazy"),
    context=(
        "The weight is a hundred times that of the presets, and the form not robust,\n"
        "so that the penalty shows in how stiff the warp is; pictures are worse for\n"
        "it. The presets of small fields ask for theirs at one step of five; they\n"
        "did at each when [ablate_fields.md](ablate_fields.md) and\n"
        "[league.md](league.md) were measured."
    ),
)
