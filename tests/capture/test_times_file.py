"""Times of frames from a file: its forms, what it changes, and what is refused."""

import functools
import json

import numpy as np
import pytest

from nerfies_jax.capture import formats, nerfies_format, times_file
from tests.capture.broken import refused
from tests.scenes import tiny_capture

NAMES = tiny_capture().ids  # two cameras: 0_00000 to 0_00005, and 1_00002
SECONDS = (10.0, 10.5, 11.0, 12.5, 13.0, 14.0, 11.0)
EXPECTED = (np.array(SECONDS) - 10) / 4


def lines(form, names=NAMES):
    rows = zip(names, SECONDS, strict=True)
    return "".join(form.format(name=name, seconds=each) + "\n" for name, each in rows)


FORMS = {
    "spaces": ("a.txt", lines("{name} {seconds}")),
    "time first, as TUM": (
        "a.txt",
        "# time file\n" + lines("{seconds} rgb/{name}.png"),
    ),
    "a table": ("a.csv", "file,seconds\n" + lines("images/{name}.PNG, {seconds}")),
    "dates": ("a.csv", lines('"{name}", 2024-01-31 00:00:{seconds:04.1f}')),
    "numbers alone": ("a.txt", lines("{seconds}")),
    "object": ("a.json", json.dumps(dict(zip(NAMES, SECONDS, strict=True)))),
    "list": ("a.json", json.dumps(SECONDS)),
    "more than there are": ("a.txt", "other.png 3\n" + lines("{name} {seconds}")),
}


@pytest.mark.parametrize("form", FORMS)
def test_times_of_every_form_are_spread(form, tmp_path):
    name, text = FORMS[form]
    (tmp_path / name).write_text(text)
    capture = times_file.with_times(tiny_capture(), tmp_path / name)
    np.testing.assert_allclose(capture.times, EXPECTED, atol=1e-7)
    assert capture.warp_ids.tolist() == [0, 1, 2, 3, 4, 5, 2]
    assert any(note.startswith(f"times from {name}: ") for note in capture.notes)
    others = "1 entries of a.txt have no frame"
    assert (others in capture.notes) == (form == "more than there are")


def test_times_replace_those_of_any_capture(tmp_path):
    nerfies_format.write(tiny_capture(), tmp_path / "a")
    file = tmp_path / "times.txt"
    file.write_text(lines("{name} {seconds}"))
    read = formats.load(tmp_path / "a", times=file)
    np.testing.assert_allclose(read.times, EXPECTED, atol=1e-7)


def test_frames_that_share_times_are_of_several_cameras(tmp_path):
    one = tiny_capture()
    names = ("a_0", "a_1", "a_2", "b_0", "b_1", "b_2", "b_3")
    one = one.__class__(
        **{**vars(one), "ids": names, "camera_ids": 0 * one.camera_ids, "flow": None}
    )
    file = tmp_path / "a.txt"
    file.write_text("\n".join(f"{name} {name[-1]}" for name in names))
    capture = times_file.with_times(one, file)
    assert capture.camera_ids.tolist() == [0, 0, 0, 1, 1, 1, 1]
    assert "taken as 2 cameras" in capture.notes[-1]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "no times; write"),
        (lines("{name} {seconds}").replace(NAMES[3], "x"), "no time for 1 of 7 frames"),
        (lines("{name} {seconds}").replace("12.5", "nan"), "'0_00003 nan' is not a"),
        (lines("{name} {seconds}").replace(" 12.5", ""), "is not a frame's name and"),
        (lines("{seconds}") + "1\n", "8 times for 7 frames"),
        (lines("{name} {seconds}") + f"{NAMES[0]} 3\n", "has two times"),
    ],
)
def test_what_leaves_a_frame_without_one_time_is_refused(text, words, tmp_path):
    (tmp_path / "a.txt").write_text(text)
    read = functools.partial(times_file.with_times, tiny_capture())
    refused(read, tmp_path / "a.txt", words)
