"""The part of other processes in a training that process 0 leads (`runtime.hosts`)."""

from nerfies_jax.runtime import hosts
from nerfies_jax.runtime.stopping import StopRequests
from nerfies_jax.training import chunk, frame_stream
from nerfies_jax.training.model import Model, TrainState


def follow(
    model: Model, example: TrainState, frames: frame_stream.TrainingFrames
) -> str:
    """Compute the share of this process of each chunk, until process 0 ends.

    A signal does not end it, because the launcher sends it to process 0 as well, which
    saves first. A second signal does.

    Args:
      model: The model, built within `data_parallel.spanning_hosts`.
      example: A state of the structure of its states.
      frames: The training frames.

    Returns:
      The error that ended process 0, empty if there was none.

    Raises:
      ValueError: If the frames have other shapes than those of process 0.
    """
    _, frames = frame_stream.replicate(frames, model.devices)
    state = example  # until the first is received
    with StopRequests() as requests:
        requests.protect()
        while True:
            message = hosts.receive()
            if message["kind"] == hosts.END:
                return message["error"]
            hosts.check_frames(message, frame_stream.layout_of(frames))
            compiles = message["kind"] == hosts.COMPILE
            if compiles or message["arrays"]:
                input_state = hosts.received_state(message, example)
            else:
                input_state = state
            program, _ = chunk.program(model, input_state, frames, message["steps"])
            if compiles:
                program.prepare(message["count"])
                hosts.meet()
            else:
                state, _ = program(input_state, frames, message["count"])
