"""Write an ablation down: the table, the claims, metrics and a picture."""

import math

import numpy as np

from experiments import ablate_arms, ablate_picture, ablate_protocol
from experiments import settings as run_settings
from experiments.ablate_arms import ARMS, MEASURES, Numbers
from nerfies_jax.measure import clock
from nerfies_jax.measure.clock import Metric


def write(job, finished) -> None:
    """ablation.json and ablation.png in the job's folder; prints table and claims.

    `finished` holds what `ablate.Job.run` returned, by arm and seed.
    """
    numbers = {key: kept.numbers for key, kept in finished.items()}
    still = ablate_protocol.still_error(job.known)
    found = ablate_arms.verdicts(numbers)
    print(ablate_arms.table(numbers, still))
    print(ablate_arms.LEGEND)
    for (name, seed), kept in finished.items():
        if kept.notes["stopped_by"] != "steps":
            print(
                f"{name}, seed {seed}: stopped at step {kept.notes['steps']} by "
                f"{kept.notes['stopped_by']}"
            )
        if kept.notes.get("points_ever_lost"):
            print(
                f"{name}, seed {seed}: {kept.notes['points_ever_lost']} of "
                f"{kept.notes['points']} points were not found at some instant"
            )
    print()
    print(ablate_arms.claims_text(found))
    about = {
        "scene": job.capture.name,
        "settings": run_settings.as_json(job.asked),
        "arms": {name: run_settings.as_json(arm) for name, arm in ARMS.items()},
        "seeds": {
            name: [s for other, s in finished if other == name]
            for name in dict.fromkeys(name for name, _ in finished)
        },
        "claims": [_claim(verdict) for verdict in found],
        "machine": clock.machine(),
    }
    clock.write_metrics(job.out / "ablation.json", metrics(numbers, still), about)
    _picture(job, finished)
    print(f"{job.out / 'ablation.png'} and {job.out / 'ablation.json'}")


def metrics(numbers: Numbers, still: float) -> list[Metric]:
    """Means over the seeds; their standard deviations where there are several."""
    found = [Metric("still.track_error", still, "scene units", "equal", 1e-6)]
    for arm in dict.fromkeys(arm for arm, _ in numbers):
        rows = [row for (name, _), row in numbers.items() if name == arm]
        for name, measure in MEASURES.items():
            values = np.asarray([row[name] for row in rows], float)
            found.append(
                Metric(
                    f"{arm}.{name}",
                    float(values.mean()),
                    measure.unit,
                    measure.direction,
                    measure.tolerance,
                )
            )
            if len(rows) > 1:
                spread = float(values.std(ddof=1))
                found.append(
                    Metric(
                        f"{arm}.{name}.spread",
                        spread,
                        measure.unit,
                        "lower",
                        measure.tolerance,
                    )
                )
    return found


def _claim(verdict):
    row = verdict._asdict()
    claim = row.pop("claim")
    row = {k: None if x != x else x for k, x in row.items()}  # NaN
    return {
        "claim": claim.statement,
        "arms": [claim.better, claim.worse],
        **row,
    }


def _picture(job, finished):
    """Of the first seed that each arm has."""
    shown = ablate_picture.shown_row(job.known, job.capture)
    first = {}
    for (name, _), kept in finished.items():
        first.setdefault(name, kept)
    captions = {}
    for name, kept in first.items():
        error = kept.numbers["track_error"]
        captions[name] = f"tracks, EPE {error:.4f}"
        if math.isnan(error):
            captions[name] = "no warp: points stay"
    ablate_picture.save(
        ablate_picture.draw(
            job.capture,
            job.known,
            {name: kept.arrays["colour"][shown] for name, kept in first.items()},
            {name: kept.arrays["depth"][shown] for name, kept in first.items()},
            {name: kept.arrays.get("path") for name, kept in first.items()},
            captions,
            shown,
        ),
        job.out / "ablation.png",
    )
