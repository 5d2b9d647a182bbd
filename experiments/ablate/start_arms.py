"""What a start from tracks, parts of the default, cameras and views are worth."""

from experiments.ablate.arms import MOVING, TRACKED, Arm, Claim, Suite
from nerfies_jax.training.track_start import FROM_REST, FROM_TRACKS

# One view a step and Gaussians that are always there, as in the presets beside it.
BASES_ALONE = ("batch_size=1", "temporal_opacity=none")

START = Suite(
    arms={
        "bases": Arm("splats-tracked-small", BASES_ALONE),
        "mlp": Arm("splats-deformable-small", (FROM_TRACKS,)),
        "kan": Arm("sonata-small", (FROM_TRACKS,)),
        "basis": Arm("moba-small", (FROM_TRACKS,)),
        "bases-from-rest": Arm("splats-tracked-small", (*BASES_ALONE, FROM_REST)),
        "mlp-from-rest": Arm("splats-deformable-small"),
        "kan-from-rest": Arm("sonata-small"),
        "basis-from-rest": Arm("moba-small"),
        "static": Arm("splats-static-small"),
    },
    claims=(
        *(
            Claim(
                f"Tracks find motion that descent on pictures does not ({what})",
                name,
                f"{name}-from-rest",
                TRACKED,
            )
            for name, what in (
                ("bases", "SE(3) bases"),
                ("mlp", "deformable 3DGS"),
                ("kan", "Sonata"),
                ("basis", "MoBa-GS"),
            )
        ),
        *(
            Claim(
                f"From tracks, few rigid motions carry more than {what}",
                "bases",
                name,
                TRACKED,
            )
            for name, what in (
                ("mlp", "an MLP"),
                ("kan", "an RBF-KAN on embeddings"),
                ("basis", "spatially varying bases"),
            )
        ),
    ),
    seeds=3,
    pictured=("bases", "mlp", "kan", "basis", "mlp-from-rest"),
    context=(
        "The kept `bases-from-rest` had no points where something moves: the random\n"
        "ones that stand in where there are no tracks are younger. With them it is\n"
        "the row `splats-tracked-small+rest` of [league.md](league.md)."
    ),
)

TRACKED_PARTS = Suite(
    arms={
        "full": Arm("splats-tracked-small"),
        "always-there": Arm("splats-tracked-small", ("temporal_opacity=none",)),
        "unfilled": Arm("splats-tracked-small", ("start.fill_hidden=False",)),
        "one-spline": Arm(
            "splats-tracked-small", ("motion.coarse_knots=0", "motion.fine_rate=1.0")
        ),
        "k4": Arm("splats-tracked-small", ("motion.bases=4",)),
        "k20": Arm("splats-tracked-small", ("motion.bases=20",)),
        "slow": Arm("splats-tracked-small", ("motion.learning_rate=1e-4",)),
        "flow": Arm("splats-tracked-small", ("flow.start=0",)),
        "true-motion": Arm("splats-tracked-small", told=True),
    },
    claims=(
        Claim(
            "Gaussians that are there for a part of the film show more",
            "full",
            "always-there",
            TRACKED,
        ),
        Claim("What is hidden is better guessed", "full", "unfilled", TRACKED),
        Claim("A second spline of few knots helps", "full", "one-spline", TRACKED),
        Claim("Eight bases beat four", "full", "k4", TRACKED),
        Claim("Eight bases beat twenty", "full", "k20", TRACKED),
        Claim("Motion has more to learn", "full", "slow", TRACKED),
        Claim("Flow has more to teach than its start", "flow", "full", TRACKED),
        Claim("True motion beats what is found", "true-motion", "full", TRACKED),
    ),
    seeds=3,
    pictured=("full", "true-motion", "one-spline", "k4", "k20"),
    context="",
)

REFINED = "poses=PoseRefinementSpec"

POSES = Suite(
    arms={
        "as-noted": Arm("splats-tracked-small"),
        "refined": Arm("splats-tracked-small", (REFINED,)),
        "refined-slowly": Arm(
            "splats-tracked-small",
            (REFINED, "poses.learning_rate=3e-5", "poses.learning_rate_end=3e-6"),
        ),
        "motion-gs": Arm("motion-gs-small"),  # its flow moves cameras as well
        "motion-gs-refined": Arm("motion-gs-small", (REFINED,)),
    },
    claims=(
        Claim("Cameras have more to learn", "refined", "as-noted", TRACKED),
        Claim("So they have slowly", "refined-slowly", "as-noted", TRACKED),
        Claim("So they have beside a flow", "motion-gs-refined", "motion-gs", TRACKED),
    ),
    seeds=3,
    pictured=("as-noted", "refined", "refined-slowly"),
    context="",
)

VIEWS = Suite(
    arms={
        "one": Arm("splats-tracked-small", ("batch_size=1",)),
        "two": Arm("splats-tracked-small"),
        "four": Arm("splats-tracked-small", ("batch_size=4",)),
    },
    claims=(
        Claim("Two views in a step reach more than one", "two", "one", MOVING),
        Claim("Four views in a step reach more than two", "four", "two", MOVING),
    ),
    seeds=3,
    pictured=("one", "two", "four"),
    context=(
        "Views of a step are drawn on a core each, where arms are trained one after\n"
        "the other; with `--jobs 2` an arm has one core. Rates go with the root of\n"
        "the number of views."
    ),
)
