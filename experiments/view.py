"""View a run in the browser: any view, any time, effects on and off.

nerfies view RUN                # and open the address it prints
nerfies view RUN --max-side 640
"""

import contextlib
import dataclasses
import pathlib
import time
from typing import Literal

from experiments import cli
from nerfies_jax.runtime import console, stopping


@dataclasses.dataclass(frozen=True)
class View:
    """View a run in the browser of this machine.

    Orbit with the mouse. Time, the shown channel, effects and a camera path are on the
    page. The browser renders Gaussians itself. Fields, depth, opacity and motion are
    rendered here, coarsely while the view moves, then up to the full size.
    """

    run: cli.Positional[pathlib.Path]
    """Run folder that nerfies reconstruct made, or is making: then as it was last
    saved."""
    port: int = cli.VIEW_PORT
    """Port on this machine. The next free one is used."""
    max_side: int | None = None
    """Longest side of the finest images rendered here, in pixels (default: as
    trained)."""
    trust: cli.Code = ()
    """Code from other packages that the run was trained with, as MODULE:NAME. It is
    loaded only if it is named here again."""
    device: Literal["auto", "cpu", "gpu", "tpu"] = "auto"
    """Device to compute on."""

    def __post_init__(self):
        cli.check_port(self.port)
        cli.check_max_side(self.max_side)


@cli.command(View)
def main(args):
    """Run the command. Wrong input ends it with exit code 2."""
    with cli.user_errors():
        cli.start_for_run(args)
        from nerfies_jax import runs
        from nerfies_jax.runs import curves, viewer

        viewer.check_installed()
        run = runs.saved_run(args.run, trusted=args.trust)
        run_checkpoint = runs.restore(args.run, run)
        size = cli.scale_size(run.capture.size, args.max_side)
        page = viewer.Viewer(run, size, args.port, args.run)
        course = curves.course_of(args.run)
        rows = (run_checkpoint.record or {}).get("rows", ())
        for row in rows if course is None else course.training or rows:
            page.training.add(int(row["step"]), row)
    if course is not None and not course.ended:
        console.say(
            f"the run has not ended: {course.line()}; shown is what it saved last"
        )
    console.say(f"look around at {page.address} (Ctrl-C ends)")
    with contextlib.suppress(KeyboardInterrupt):
        while not stopping.requested():
            page.serve(run_checkpoint.state, run_checkpoint.step, seconds=1.0)
            time.sleep(viewer.IDLE_SECONDS)
    page.close()
    return {"run": args.run, "step": run_checkpoint.step, "address": page.address}


if __name__ == "__main__":
    main()
