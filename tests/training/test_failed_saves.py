"""A checkpoint that cannot be written costs a line, not the training."""

import errno
import io
import itertools
import os
import shutil
import tempfile
import time

import pytest
import rich.console

from nerfies_jax.training import checkpoint, loop
from tests.training import toy

SPEC = toy.ToySpec()


@pytest.fixture(scope="module")
def straight():
    return toy.fit(toy.frames(), steps=20)


def lose_folder(folder, patch):
    shutil.rmtree(folder)


def lose_settings(folder, patch):
    (folder.parent / "config.json").unlink()


def fill_disk(folder, patch):
    full = shutil.disk_usage(folder)._replace(free=100)
    patch.setattr(shutil, "disk_usage", lambda path: full)


def make_read_only(folder, patch):
    def refuse(**_):
        raise OSError(errno.EROFS, os.strerror(errno.EROFS))

    patch.setattr(tempfile, "TemporaryFile", refuse)


@pytest.mark.parametrize(
    ("harm", "words", "whole"),
    [
        (fill_disk, "no space: up to 1.0 MB are needed", "step 10 is intact"),
        *(
            pytest.param(*rest, marks=pytest.mark.full)
            for rest in (
                (lose_folder, "No such file", "no earlier checkpoint"),
                (lose_settings, "config.json no longer exists", "step 10 is intact"),
                (make_read_only, "Read-only file system", "step 10 is intact"),
            )
        ),
    ],
)
def test_training_goes_on_where_saving_fails_and_says_so(
    harm, words, whole, straight, tmp_path, monkeypatch
):
    """Whether the trouble passes before the end or not; nothing hangs."""
    settings = tmp_path / "config.json"
    for passes in (True, False):
        folder = tmp_path / f"passes {passes}"
        settings.touch()
        with (
            monkeypatch.context() as patch,
            checkpoint.Checkpoints(folder, SPEC, beside=settings) as checkpoints,
        ):

            def disturb(
                state, step, metrics, patch=patch, folder=folder, passes=passes
            ):
                if step == 11:
                    checkpoints.wait()  # for the save of step 10
                    harm(folder, patch)
                if step == 19 and passes:
                    patch.undo()
                    folder.mkdir(exist_ok=True)
                    settings.touch()

            printed = io.StringIO()
            result = toy.fit(
                toy.frames(),
                steps=20,
                console=rich.console.Console(file=printed),
                hooks=[loop.Hook("disturb", disturb, every_steps=1)],
                checkpoints=checkpoints,
                checkpoint_seconds=0.0,
            )
        assert toy.same(result.state, straight.state)
        warned = f"warning: cannot write checkpoints to {folder}: "
        assert warned in printed.getvalue()
        assert words in printed.getvalue()
        assert f"{whole}; training continues" in printed.getvalue()
        if passes:
            assert result.unsaved == ""
            assert checkpoint.latest(folder) == 20
            assert f"saved in {folder}" in result.message
        else:
            assert words in result.unsaved
            assert whole in result.unsaved
            assert "saved in" not in result.message
            assert not list(tmp_path.rglob("*.unfinished"))


def test_saving_does_not_read_the_wall_clock(tmp_path, monkeypatch):
    """Set a day ahead at every look: orbax's own waiting would give up."""
    days = itertools.count()
    monkeypatch.setattr(time, "time", lambda: 1.8e9 + 86_400.0 * next(days))
    with checkpoint.Checkpoints(tmp_path, SPEC) as checkpoints:
        checkpoints.save(toy.start(), 3)
    assert checkpoint.restore(tmp_path, toy.start(), SPEC).step == 3
