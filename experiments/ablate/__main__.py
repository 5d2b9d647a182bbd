"""What each part of a method is worth: the whole of it against itself without the part.

    python -m experiments.ablate                                  # radiance fields
    python -m experiments.ablate --suite sonata --jobs 4          # Sonata's ablation
    python -m experiments.ablate --suite moba --steps 2000 --seconds 120 --jobs 4
    python -m experiments.ablate --arms static nerfies --scene fast --budget 30
    python -m experiments.ablate --suite sonata --capture FOLDER  # pictures alone

All arms of a suite learn the same frames from the same seeds, over as many steps
(--steps), as much time (--seconds), or first the one and then the other; the last
iterate counts. Prints a table and what it says of the claims, writes ablation.json and
ablation.png. Finished arms are kept in --out: the same command goes on where it was
stopped.
"""

from experiments import cli
from experiments.ablate import settings, suites
from experiments.ablate.settings import Ablate
from nerfies_jax import console
from nerfies_jax.runs import platform, representations


@cli.command(Ablate)
def main(args):
    """Run the job of the command line; exit code 2 where its input is wrong."""
    with cli.user_errors():
        settings.check(args)
        platform.start_jax(args.device, *_cores(args))
        from experiments.ablate.job import Job

        job = Job(args)
    failed = job.run()
    reports = _report(job) if args.seed is None else {}
    return cli.Ended(reports, 1 if failed else 0)


def _cores(args):
    """What XLA is to see: enough for every arm, where each is trained alone."""
    arms = suites.named(args.suite).arms
    wanted = [
        representations.cores(arm.preset, (*arm.changes, *args.set))
        for arm in (arms[name] for name in args.arms or arms)
    ]
    threads = "all" if any(cores.threads == "all" for cores in wanted) else "one"
    shares = max(cores.shares for cores in wanted) if args.jobs == 1 else 1
    return representations.Cores(threads, shares)


def _report(job):
    """What ablation.json has, by the budget that the arms were trained under."""
    reports = {}
    for budget in job.budgets:
        finished = job.finished(budget)
        if finished:
            from experiments.ablate import report

            report.write(job, budget, finished)
            reports[budget.title] = cli.stored(budget.folder / "ablation.json")
    missing = job.missing()
    if missing:
        console.say(
            f"{len(missing)} arms and seeds are left: "
            + ", ".join(f"{name} {seed}" for name, seed in missing)
            + f"; the same command with --out {job.out} goes on"
        )
    return reports


if __name__ == "__main__":
    main()
