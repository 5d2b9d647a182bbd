"""Fit the toy model in a process of its own: run_toy.py FOLDER STEPS [SLOW].

Resumes whatever FOLDER holds. Prints READY before the first step and ends with a line
of JSON: why it stopped, the step it went on from, and a digest of the state.
"""

import hashlib
import json
import sys
import time

import jax

from nerfies_jax.training import checkpoint, loop
from tests.training import toy


def digest(state):
    return hashlib.sha256(
        b"".join(toy.bits(x) for x in jax.tree.leaves(state))
    ).hexdigest()


def main(folder, steps, slow=0.0):
    jax.config.update("jax_numpy_dtype_promotion", "strict")
    spec = toy.ToySpec()
    model = toy.model(spec)
    state = model.init(None, jax.random.key(5))
    after, history = None, loop.History()
    if checkpoint.latest(folder) is not None:
        restored = checkpoint.restore(folder, state, spec)
        state, after = restored.state, restored.step
        history = loop.History(**restored.record)
    # SLOW stretches the run on the host, where signals and kills arrive.
    hooks = (loop.Hook("slow", lambda *_: time.sleep(slow), every_steps=1),)
    print("READY", flush=True)
    with checkpoint.Checkpoints(folder, spec, after=after) as checkpoints:
        result = loop.fit(
            model,
            state,
            toy.frames(),
            steps=steps,
            hooks=hooks if slow else (),
            checkpoints=checkpoints,
            checkpoint_seconds=0.05,
            history=history,
        )
    report = {
        "stopped_by": result.stopped_by,
        "from": after,
        "steps": result.steps,
        "rows": len(result.history.rows),
        "digest": digest(result.state),
    }
    print(json.dumps(report))


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), *(float(x) for x in sys.argv[3:]))
