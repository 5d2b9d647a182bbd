"""Write an ablation down: the table, the claims, metrics and a picture."""

import math

from experiments import asked
from experiments.ablate import arms, measures, picture, verdicts
from experiments.ablate.measures import MEASURES
from experiments.ablate.verdicts import Numbers
from nerfies_jax.evaluation import protocol
from nerfies_jax.metrics import clock
from nerfies_jax.metrics.clock import Metric
from nerfies_jax.runtime import console
from nerfies_jax.training import specs


def write(job, budget, finished) -> None:
    """Write ablation.json and ablation.png of a budget, and print the table and the
    claims.

    Args:
      job: The ablation.
      budget: The budget.
      finished: Finished runs of this budget, by method and seed.
    """
    numbers = {key: kept.numbers for key, kept in finished.items()}
    static = protocol.static_error(job.known)
    judged_claims = verdicts.verdicts(numbers, judged(job))
    console.say(f"\n{job.capture.name}, each arm trained {budget.title}:")
    console.say(verdicts.table(numbers, static))
    console.say(measures.legend(measures.shown(numbers)))
    for line in remarks(finished):
        console.say(line)
    console.say()
    console.say(
        verdicts.claims_text(judged_claims) or "no claim has both of its arms here"
    )
    if job.suite.context:
        console.say("\n" + job.suite.context)
    about = {
        "capture": job.capture.name,
        "settings": asked.without_places(job.args),
        "budget": {"steps": budget.steps, "seconds": budget.seconds},
        "trained": budget.title,
        "arms": {name: specs.as_json(arm) for name, arm in job.suite.arms.items()},
        "seeds": {
            name: [s for other, s in finished if other == name]
            for name in dict.fromkeys(name for name, _ in finished)
        },
        "claims": [_claim(verdict) for verdict in judged_claims],
        "machine": clock.machine(),
    }
    clock.write_metrics(
        budget.folder / "ablation.json", metrics(numbers, static), about
    )
    _picture(job, finished, budget.folder / "ablation.png")
    console.say(
        f"{budget.folder / 'ablation.png'} and {budget.folder / 'ablation.json'}"
    )


def judged(job) -> list:
    """The claims of the suite, by pictures alone where no truth is known."""
    if job.known.exact:
        return list(job.suite.claims)
    return [claim._replace(measures=arms.PICTURES) for claim in job.suite.claims]


def remarks(finished) -> list[str]:
    """Report what the table does not show: runs that ended early, points that were
    lost.
    """
    sentences = []
    for (name, seed), kept in finished.items():
        if kept.notes["stopped_by"] != "steps":
            sentences.append(
                f"{name}, seed {seed}: stopped at step {kept.notes['steps']} by "
                f"{kept.notes['stopped_by']}"
            )
        if kept.notes.get("points_ever_lost"):
            sentences.append(
                f"{name}, seed {seed}: {kept.notes['points_ever_lost']} of "
                f"{kept.notes['points']} points were not found at some instant"
            )
    return sentences


def metrics(numbers: Numbers, static: float) -> list[Metric]:
    """Compute means over the seeds, and standard deviations if there are several.

    Args:
      numbers: Measures by method and seed.
      static: End-point error of a static prediction.

    Returns:
      Metrics by key.
    """
    measured = [Metric("still.track_error", static, "scene units", "equal", 1e-6)]
    for arm in dict.fromkeys(arm for arm, _ in numbers):
        rows = [row for (name, _), row in numbers.items() if name == arm]
        for name, measure in MEASURES.items():
            values = verdicts.values_of(rows, name)
            mean = float(values.mean())
            allowed = measure.allowed(mean)
            measured.append(
                Metric(f"{arm}.{name}", mean, measure.unit, measure.direction, allowed)
            )
            if len(values) > 1:
                spread = float(values.std(ddof=1))
                measured.append(
                    Metric(
                        f"{arm}.{name}.spread",
                        spread,
                        measure.unit,
                        "lower",
                        allowed,
                    )
                )
    return measured


def _claim(verdict):
    row = verdict._asdict()
    claim = row.pop("claim")
    row = {k: None if x != x else x for k, x in row.items()}  # NaN
    return {
        "claim": claim.statement,
        "arms": [claim.better, claim.worse],
        **row,
    }


def _picture(job, finished, path):
    """Draw the first finished seed of a few methods."""
    first = {}
    for (name, _), kept in finished.items():
        first.setdefault(name, kept)
    few = [name for name in job.suite.pictured if name in first]
    first = {name: first[name] for name in few or list(first)}
    shown = picture.shown_row(job.known, job.filmed)
    captions = {}
    for name, kept in first.items():
        error = kept.numbers["track_error"]
        captions[name] = f"tracks, EPE {error:.4f}"
        if math.isnan(error):
            captions[name] = "no motion: points stay"
    picture.save(
        picture.draw(
            job.filmed,
            job.known,
            {name: kept.arrays["color"][shown] for name, kept in first.items()},
            {name: kept.arrays["depth"][shown] for name, kept in first.items()},
            {name: kept.arrays.get("path") for name, kept in first.items()},
            captions,
            shown,
        ),
        path,
    )
