"""Stands for `experiments.reconstruct`: a process that writes what a run writes.

The name of the capture says what happens to it.
"""

import json
import os
import pathlib
import signal
import sys
import time

MACHINE = {"cpu": "one", "backend": "cpu", "jax": "0"}


def command(task, words):
    """For `Task.command`."""
    return [sys.executable, __file__, *words[1:]]


def _save(*_):
    print("saved", flush=True)
    sys.exit(128 + signal.SIGTERM)


def _suffer(capture):
    """What happens the first time."""
    if capture == "killed":
        os.kill(os.getpid(), signal.SIGKILL)
    if capture == "hungry":
        held = bytearray(400_000_000)
        time.sleep(60)
        print(len(held))
    if capture == "preempted":
        signal.signal(signal.SIGTERM, _save)
        pathlib.Path("../supervisor").write_text(str(os.getppid()))
        time.sleep(60)


def main(words):
    out = pathlib.Path(words[words.index("--out") + 1])
    log = out.with_suffix(".calls")
    log.write_text((log.read_text() if log.exists() else "") + " ".join(words) + "\n")
    out.mkdir(exist_ok=True)
    os.chdir(out)
    preset = words[words.index("--preset") + 1] if "--preset" in words else "nerf-small"
    config = {"preset": preset}
    pathlib.Path("config.json").write_text(json.dumps({"config": config, "spec": {}}))
    print("at work", flush=True)
    time.sleep(float(os.environ.get("WAIT", "0")))
    capture = pathlib.Path(words[0]).name
    if "rays=-1" in words or capture == "broken":
        sys.exit(print("error: rays=-1") or 2)
    if out.name.startswith("sonata"):
        sys.exit("no such luck")
    if "--resume" not in words:
        _suffer(capture)
    seed = int(words[words.index("--seed") + 1])
    metrics = {"heldout.psnr": 20.0 + seed, "train.seconds": 1.0, "tracks.epe": None}
    pathlib.Path("metrics.json").write_text(json.dumps(metrics))
    point = {"hook": "held out", "step": 9, "seconds": 1, "cpu_seconds": 2}
    point |= {"psnr": 20.1234, "ssim": 0.5}
    curve = {"evaluations": [point], "frames": ["a"]}
    curve |= {"compile_seconds": 1, "machine": MACHINE}
    pathlib.Path("curve.json").write_text(json.dumps(curve))


if __name__ == "__main__":
    main(sys.argv[1:])
