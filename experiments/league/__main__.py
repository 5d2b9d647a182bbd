"""Every small preset by one protocol: equal processor seconds, seeds, paired verdicts.

    python -m experiments.league --jobs 2 --budget 600
    python -m experiments.league CAPTURE OTHER --heldout 8 --own-steps --jobs 2
    python -m experiments.league --presets sonata-small --budgets 20 --seeds 1

Both representations learn the same frames of the built-in scenes, and of the captures
that are named, from the same seeds. A row is a preset as it is, or with its motion
started the other way: fitted to tracks before training, or from rest; neither finding
tracks nor fitting to them is in the seconds. Each row gets as many steps as it can make
in so many processor seconds on one core, without compiling. A cell is one row, film,
length and seed, trained in a process of its own: all cells of the first seed come
first, and short lengths before long ones. What is finished is kept in --out, and
the same command goes on where it was stopped or where --budget ended it; with --keep
also from another clone, with the cells that are kept beside the code and would be made
with the same settings today, but for rows that are to be made --anew. Writes
league.json and league.png there; rows that lose stay in.
"""

from experiments import cli
from experiments.league import rows
from experiments.league.settings import League
from nerfies_jax import console
from nerfies_jax.runs import platform


@cli.command(League)
def main(args):
    """Run the job of the command line; exit code 2 where its input is wrong."""
    with cli.user_errors():
        arms = rows.of_presets(args.presets)
        platform.start_jax(args.device)
        from nerfies_jax.capture import formats

        for folder in args.captures:
            formats.recognize(folder)
        from experiments import results
        from experiments.league import contests

        every = contests.opened(args, arms)
    if args.keep:
        kept = contests.kept(results.ROOT / results.STUDIES["league"].measured)
        with cli.user_errors():
            kept = contests.without(kept, args.anew, every)
        count = contests.restore(kept, every)
        if count:
            console.say(f"{count} cells are kept from before and are not made again")
    failed = contests.run(args, every)
    path = args.out / "league.json"
    stored = contests.record(args, every)
    contests.write(path, stored)
    if args.keep:
        with cli.user_errors():
            stored = contests.merged(kept, stored)
        contests.write(path, stored)
    from experiments.league import page

    page.draw(stored, path.with_suffix(".png"))
    console.say("\n" + page.page(stored))
    console.say(f"\n{path} and {path.with_suffix('.png')}")
    if args.keep:
        results.main(["league", "--measured", str(path)])
    return cli.Ended(stored, 1 if failed else 0)


if __name__ == "__main__":
    main()
