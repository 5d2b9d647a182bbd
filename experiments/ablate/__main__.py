"""Ablation of methods: each is compared with itself without one part.

    python -m experiments.ablate                                  # radiance fields
    python -m experiments.ablate --suite sonata --jobs 4          # Sonata's ablation
    python -m experiments.ablate --suite moba --steps 2000 --seconds 120 --jobs 4
    python -m experiments.ablate --arms static nerfies --scene fast --budget 30
    python -m experiments.ablate --suite sonata --capture FOLDER  # without ground truth

All methods of a suite train on the same frames with the same seeds, for the same number
of steps (--steps), the same time (--seconds), or first one and then the other. The last
iterate is measured. Prints a table and a verdict on each claim, and writes
ablation.json and ablation.png. Finished runs are kept in --out, and the same command
continues where it was stopped.
"""

from experiments import cli
from experiments.ablate import settings, suites
from experiments.ablate.settings import Ablate
from nerfies_jax.runs import platform, representations
from nerfies_jax.runtime import console


@cli.command(Ablate)
def main(args):
    """Run the command. Wrong input ends it with exit code 2."""
    with cli.user_errors():
        settings.check(args)
        platform.start_jax(args.device, *_cores(args))
        from experiments.ablate.job import Job

        job = Job(args)
    failed = job.run()
    reports = _report(job) if args.seed is None else {}
    return cli.Ended(reports, 1 if failed else 0)


def _cores(args):
    """Return the number of cores that XLA sees, enough for runs that train one at a
    time.
    """
    arms = suites.named(args.suite).arms
    wanted = [
        representations.cores(arm.preset, (*arm.changes, *args.set))
        for arm in (arms[name] for name in args.arms or arms)
    ]
    threads = "all" if any(cores.threads == "all" for cores in wanted) else "one"
    shares = max(cores.shares for cores in wanted) if args.jobs == 1 else 1
    return representations.Cores(threads, shares)


def _report(job):
    """Assemble ablation.json, by the budget of the runs."""
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
