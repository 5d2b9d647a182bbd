"""How far a run is: a live bar on a terminal, a line every ten seconds elsewhere."""

import contextlib
import math
import time

import rich.console
import rich.progress

LINE_SECONDS = 10.0  # between lines in a log file
BAR_SECONDS = 0.2  # between updates of a terminal


class Progress:
    """Steps, steps per second, loss, PSNR, counts and remaining time on a console."""

    def __init__(self, console: rich.console.Console | None, start: int, total: int):
        self._console = console or rich.console.Console(stderr=True)
        self._total = total
        self._shown = -float("inf")
        self._bar = None
        if self._console.is_terminal and not self._console.quiet:
            columns = rich.progress
            self._bar = columns.Progress(
                columns.BarColumn(bar_width=24),
                columns.MofNCompleteColumn(),
                columns.TextColumn("{task.fields[text]}"),
                console=self._console,
            )
            self._task = self._bar.add_task("", total=total, completed=start, text="")

    def __enter__(self):
        if self._bar is not None:
            self._bar.start()
        return self

    def __exit__(self, *_):
        if self._bar is not None:
            with contextlib.suppress(OSError):
                self._bar.stop()

    def due(self) -> bool:
        """Whether enough time has passed to be worth an update."""
        wait = LINE_SECONDS if self._bar is None else BAR_SECONDS
        return time.monotonic() - self._shown >= wait

    def update(
        self,
        step: int,
        rate: float,
        metrics: dict[str, float],
        counts: dict[str, int],
        left: float,
    ) -> None:
        """Show `rate` steps per second and `left` seconds that remain."""
        self._shown = time.monotonic()
        parts = [f"{rate:.3g} steps/s"]
        if "loss" in metrics:
            parts.append(f"loss {metrics['loss']:.4g}")
        if metrics.get("mse", 0) > 0:
            parts.append(f"PSNR {-10 * math.log10(metrics['mse']):.2f} dB")
        parts += [f"{count:,} {name}" for name, count in counts.items()]
        parts.append(f"{duration(left)} left")
        if self._bar is not None:
            self._bar.update(self._task, completed=step, text="  ".join(parts))
        else:
            self.log(f"step {step:,} of {self._total:,}  " + "  ".join(parts))

    def log(self, text: str) -> None:
        """One line that stays."""
        # A terminal that was closed must not keep its run from being saved.
        with contextlib.suppress(OSError):
            self._console.print(text, highlight=False, markup=False, soft_wrap=True)


def duration(seconds: float) -> str:
    """Hours, minutes and seconds, as short as they can be read: 1:02:03, 2:05."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}" if hours else f"{minutes}:{rest:02}"
