"""Checkpoints: whole or absent, refused when foreign, and resumed to the last bit."""

import dataclasses
import json
import math
import os
import pathlib
import subprocess
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nerfies_jax.training import best, checkpoint, loop
from nerfies_jax.training.specs import as_json, differences
from tests.training import run_toy, toy
from tests.training.toy import start

ROOT = pathlib.Path(__file__).resolve().parents[2]
SPEC = toy.ToySpec()


def save(folder, *saved, spec=SPEC, keep=3, after=None):
    with checkpoint.Checkpoints(folder, spec, keep=keep, after=after) as checkpoints:
        for state, step in saved:
            checkpoints.save(state, step, {"note": step})


def fit(state, folder, steps, after=None, **settings):
    with checkpoint.Checkpoints(folder, SPEC, after=after) as checkpoints:
        return toy.fit(
            toy.frames(), state, steps=steps, checkpoints=checkpoints, **settings
        )


@pytest.fixture(scope="module")
def straight():
    return toy.fit(toy.frames(), steps=20)


def test_what_is_restored_is_what_was_saved(tmp_path, dtype):
    arrays = {
        "wide": np.asarray([[0.1, -0.0, 1e-30]], dtype),
        "half": np.asarray([1.5, 2.0], jnp.bfloat16),
        "empty": np.zeros((3, 0, 2), dtype),
        "scalar": np.asarray(7, np.int32),
        "flags": np.asarray([True, False]),
        "bytes": np.asarray([0, 255], np.uint8),
        "infinite": np.asarray([np.inf, np.nan], dtype),
    }
    state = jax.device_put(arrays) | {
        "key": jax.random.key(3),
        "other key": jax.random.key(3, impl="rbg"),
        "several": jax.random.split(jax.random.key(1), 4),
    }
    save(tmp_path, (state, 12))
    restored = checkpoint.restore(tmp_path, jax.eval_shape(lambda: state), SPEC)
    assert toy.same(restored.state, state)
    assert restored.state["other key"].dtype == state["other key"].dtype
    assert restored.step == 12
    assert restored.record == {"note": 12}
    assert checkpoint.latest(tmp_path) == 12


def test_a_checkpoint_says_what_made_it(tmp_path):
    save(tmp_path, (start(), 0))
    about = checkpoint.restore(tmp_path, start(), SPEC).about
    assert about["jax"] == jax.__version__
    assert about["spec"]["grow_at"] == [7]
    commit = subprocess.run(
        ["git", "-C", ROOT, "rev-parse", "HEAD"], capture_output=True, text=True
    ).stdout.strip()
    if commit:
        assert about["revision"].removesuffix("+changes") == commit


@pytest.mark.parametrize("cut", [7, pytest.param(8, marks=pytest.mark.full)])
def test_a_resumed_run_is_the_straight_run_bit_for_bit(cut, tmp_path, straight):
    first = fit(start(), tmp_path, cut)
    restored = checkpoint.restore(tmp_path, start(), SPEC)  # of the first capacity
    assert toy.same(restored.state, first.state)
    history = loop.History(**restored.record)
    second = fit(restored.state, tmp_path, 20, after=restored.step, history=history)
    assert toy.same(second.state, straight.state)
    assert checkpoint.latest(tmp_path) == 20
    assert second.seconds > first.seconds
    assert second.history.cpu_seconds > first.history.cpu_seconds > 0
    assert second.history.rows[0]["step"] == 1


@pytest.mark.parametrize("checkpoint_seconds", [0.0, 60.0])
def test_a_complete_run_keeps_one_last_evaluation(checkpoint_seconds, tmp_path):
    """Whenever it saves, and though it is resumed for its products."""
    hooks = [loop.Hook("score", lambda _, step, metrics: {"psnr": step}, every_steps=6)]
    state, history, after = None, loop.History(), None
    for _ in range(2):
        result = fit(
            state,
            tmp_path,
            10,
            after,
            hooks=hooks,
            history=history,
            checkpoint_seconds=checkpoint_seconds,
        )
        assert [row["step"] for row in result.history.evaluations] == [6, 10]
        stored = checkpoint.restore(tmp_path, start(), SPEC)
        assert [row["step"] for row in stored.record["evaluations"]] == [6, 10]
        state, after, history = stored.state, stored.step, loop.History(**stored.record)


def test_a_run_out_of_time_keeps_its_last_evaluation(tmp_path):
    """Though an overdue save falls on the step at which the time is over."""
    hook = loop.Hook(
        "score", lambda _, step, metrics: {"psnr": step}, every_steps=10**6
    )
    result = fit(
        start(), tmp_path, 10**6, hooks=[hook], seconds=0.05, checkpoint_seconds=0.0
    )
    assert result.stopped_by == "seconds"
    assert 0 not in checkpoint.steps(tmp_path)
    stored = checkpoint.restore(tmp_path, start(), SPEC)
    assert stored.step == result.steps
    assert [row["step"] for row in stored.record["evaluations"]] == [result.steps]


def test_only_the_newest_checkpoints_stay(tmp_path):
    state = start()
    save(tmp_path, *((state, step) for step in (1, 5, 9, 12)), keep=2)
    assert checkpoint.steps(tmp_path) == [9, 12]


@pytest.mark.parametrize("cut", [12, 20])
def test_the_best_validated_state_stays_also_after_a_resume(cut, tmp_path, straight):
    """Saved when it is evaluated, though no other checkpoint is due or kept."""
    scores = {4: 20.0, 8: 31.0, 12: 30.0, 16: 29.0, 20: 30.5}
    hook = loop.Hook(
        best.VALIDATION, lambda _, step, metrics: {"psnr": scores[step]}, every_steps=4
    )
    state, history, after = start(), loop.History(), None
    for steps in (cut, 20):
        with checkpoint.Checkpoints(tmp_path, SPEC, keep=1, after=after) as checkpoints:
            toy.fit(
                toy.frames(),
                state,
                steps=steps,
                checkpoints=checkpoints,
                hooks=[hook],
                history=history,
            )
        restored = checkpoint.restore(tmp_path, start(), SPEC)
        state, after = restored.state, restored.step
        history = loop.History(**restored.record)
    assert toy.same(state, straight.state)
    assert checkpoint.steps(tmp_path) == [8, 20]
    assert best.best_step(history.evaluations) == 8
    best_state = checkpoint.restore(tmp_path, start(), SPEC, step=8).state
    assert toy.same(best_state, toy.fit(toy.frames(), steps=8).state)


def test_an_earlier_state_must_be_clearly_better():
    def rows(*scores):
        named = enumerate(scores, start=1)
        return [{"hook": "validation", "step": s, "psnr": x} for s, x in named]

    other = {"hook": "held out", "step": 9, "psnr": 99.0}
    assert best.best_step([]) is best.best_step([other]) is None
    assert best.best_step([other, *rows(30.0, 31.0, 30.95)]) == 3
    assert best.best_step([other, *rows(30.0, 31.0, 30.8)]) == 2
    assert best.best_step(rows(30.0, math.nan, math.nan)) == 1
    assert best.highest_step(rows(31.0, 31.0, 30.95)) == 2


def test_a_checkpoint_of_another_spec_lists_what_differs(tmp_path):
    save(tmp_path, (start(), 3))
    other = toy.ToySpec(rows=9, grow_at=(7, 8))
    with pytest.raises(ValueError, match="was made with other settings") as error:
        checkpoint.restore(tmp_path, start(), other)
    message = str(error.value)
    assert "spec.rows: saved 6, now 9" in message
    assert "spec.grow_at[1]: saved absent, now 8" in message
    assert "rate" not in message


def damage_truncate(folder):
    for path in (folder / "state").rglob("*"):
        if path.is_file() and path.stat().st_size > 200:
            path.write_bytes(path.read_bytes()[:100])


def damage_flip(folder):
    # A bit in every eighth of every file: one alone may hit a stretch that is not read.
    for path in (folder / "state").rglob("d/*"):
        data = bytearray(path.read_bytes())
        for part in range(8):
            data[(2 * part + 1) * len(data) // 16] ^= 0x10
        path.write_bytes(data)


def damage_lose_arrays(folder):
    for path in (folder / "state").rglob("d/*"):
        path.unlink()


def damage_lose_notes(folder):
    (folder / "about.json").unlink()


def edit_notes(folder, **values):
    path = folder / "about.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | values))


def damage_notes(folder):
    edit_notes(folder, step=7)


# When one array cannot be read, orbax closes its event loop on the reads of the others.
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.parametrize(
    "damage",
    [
        damage_flip,
        damage_lose_notes,
        pytest.param(damage_truncate, marks=pytest.mark.full),
        pytest.param(damage_lose_arrays, marks=pytest.mark.full),
        pytest.param(damage_notes, marks=pytest.mark.full),
    ],
)
def test_a_damaged_newest_checkpoint_falls_back_to_the_one_before(damage, tmp_path):
    older, newer = start(), start(6)
    save(tmp_path, (older, 4), (newer, 8))
    damage(tmp_path / "8")
    with pytest.warns(RuntimeWarning, match=r"8 cannot be read .* trying an older one"):
        restored = checkpoint.restore(tmp_path, start(), SPEC)
    assert restored.step == 4
    assert toy.same(restored.state, older)
    save(tmp_path, (newer, 6), after=4)  # going on drops the damaged future
    assert checkpoint.steps(tmp_path) == [4, 6]
    damage(tmp_path / "4")
    with pytest.raises(ValueError, match=r"4 cannot be read"):
        checkpoint.restore(tmp_path, start(), SPEC, step=4)
    time.sleep(0.2)  # for those reads to complain here and not in another test


def test_an_unfinished_checkpoint_is_none(tmp_path):
    save(tmp_path, (start(), 4))
    (tmp_path / "8.unfinished" / "state").mkdir(parents=True)
    (tmp_path / "²").mkdir()  # a digit to Python, and no step
    assert checkpoint.latest(tmp_path) == 4
    assert checkpoint.restore(tmp_path, start(), SPEC).step == 4


def test_a_checkpoint_of_a_newer_format_is_refused_and_stays(tmp_path):
    save(tmp_path, (start(), 4), (start(), 8))
    edit_notes(tmp_path / "8", format=99)
    with pytest.raises(ValueError, match="has format 99, but this version reads"):
        checkpoint.restore(tmp_path, start(), SPEC)


def test_arrays_that_do_not_fit_are_named(tmp_path):
    state = start()
    save(tmp_path, (state, 1))
    wide = state.params.nets | {"weight": np.zeros((3, 9), np.float32)}
    other = state._replace(params=state.params._replace(nets=wide))
    with pytest.raises(ValueError, match=r"params\.nets\.weight as float32\[3, 8\]"):
        checkpoint.restore(tmp_path, other, SPEC)
    half = state._replace(aux_state=state.aux_state | {"hits": np.zeros(6, np.float16)})
    with pytest.raises(ValueError, match=r"this run needs float16\[6\]"):
        checkpoint.restore(tmp_path, half, SPEC)
    more = state._replace(aux_state=state.aux_state | {"new": np.zeros(6, np.float32)})
    with pytest.raises(ValueError, match=r"lacks \['aux_state.new'\]"):
        checkpoint.restore(tmp_path, more, SPEC)


def test_an_unwritable_folder_is_an_error_before_training(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(ValueError, match=r"cannot write checkpoints to .*file"):
        checkpoint.Checkpoints(tmp_path / "file", SPEC)
    with pytest.raises(ValueError, match="cannot write checkpoints to /proc/self/run"):
        checkpoint.Checkpoints("/proc/self/run", SPEC)
    with pytest.raises(ValueError, match="keep=0"):
        checkpoint.Checkpoints(tmp_path / "run", SPEC, keep=0)


def test_a_folder_in_use_is_not_written_over(tmp_path):
    save(tmp_path, (start(), 4))
    with pytest.raises(ValueError, match="already holds a run, saved at step 4"):
        checkpoint.Checkpoints(tmp_path, SPEC)


def test_nothing_to_restore_is_an_error(tmp_path):
    with pytest.raises(ValueError, match="holds no checkpoint"):
        checkpoint.restore(tmp_path / "absent", start(), SPEC)
    save(tmp_path, (start(), 4))
    with pytest.raises(ValueError, match=r"no checkpoint of step 3; choose from \[4\]"):
        checkpoint.restore(tmp_path, start(), SPEC, step=3)


@dataclasses.dataclass(frozen=True)
class Outer:
    inner: object = SPEC
    limits: tuple = (1, 2.0, None)


def test_specs_become_text_and_compare_by_field():
    text = as_json(Outer())
    assert json.loads(json.dumps(text)) == text
    assert text["inner"]["type"].endswith("ToySpec")
    assert differences(text, as_json(Outer())) == []
    nan = as_json(Outer(limits=(float("nan"),)))
    assert differences(nan, nan) == []
    changed = Outer(inner=dataclasses.replace(SPEC, rate=0.5), limits=(1, 2, None))
    assert differences(text, as_json(changed)) == [
        "spec.inner.rate: saved 0.01, now 0.5",
        "spec.limits[1]: saved 2.0, now 2",
    ]
    assert differences(text, as_json(Outer(inner=None)))[0].startswith(
        "spec.inner.type"
    )


def test_a_set_of_names_becomes_text_in_one_order():
    names = frozenset({"points", "depths", "flow"})
    assert as_json(Outer(inner=names))["inner"] == ["depths", "flow", "points"]


def test_a_spec_that_is_no_text_is_refused():
    with pytest.raises(ValueError, match=r"spec\.inner is a function"):
        as_json(Outer(inner=lambda: 1))


def launch(folder, steps, *more):
    environment = {
        **os.environ,
        "PJRT_NPROC": "1",
        "PYTHONPATH": str(ROOT),
        "JAX_COMPILATION_CACHE_DIR": jax.config.jax_compilation_cache_dir,
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
    }
    return subprocess.Popen(
        [
            sys.executable,
            "-m",
            "tests.training.run_toy",
            str(folder),
            str(steps),
            *more,
        ],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment,
        cwd=ROOT,
    )


def report(process):
    out, err = process.communicate(timeout=300)
    assert process.returncode == 0, err
    return json.loads(out.splitlines()[-1])


def wait_for_checkpoint(folder, process):
    for _ in range(600):
        if checkpoint.latest(folder) is not None or process.poll() is not None:
            return
        time.sleep(0.1)


def straight_digest(steps):
    return run_toy.digest(toy.fit(toy.frames(), steps=steps).state)


@pytest.mark.slow
def test_killed_runs_resume_from_a_whole_checkpoint_bit_for_bit(tmp_path):
    rng = np.random.default_rng(int.from_bytes(os.urandom(4)))
    folder = tmp_path / "killed"
    furthest = -1
    for _ in range(8):
        process = launch(folder, 400, "0.01")
        wait_for_checkpoint(folder, process)
        time.sleep(rng.uniform(0, 1.5))
        process.kill()
        process.communicate()
        restored = checkpoint.restore(folder, start(), SPEC)  # no warning: it is intact
        assert restored.step >= furthest
        furthest = restored.step
    assert furthest > 0
    resumed = report(launch(folder, 400))
    assert resumed["from"] == furthest
    assert resumed["digest"] == straight_digest(400)
