"""The parts of the default preset, and cameras refined in training."""

from experiments.ablate.arms import TRACKED, Arm, Claim, Suite

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
