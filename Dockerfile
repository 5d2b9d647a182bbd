# All extras on a CPU:        docker build -t nerfies .
# On NVIDIA GPUs (CUDA 12):   docker build -t nerfies --build-arg EXTRAS=all,gpu .
# A run, into ./runs:         docker run --rm -v "$PWD:/data" nerfies reconstruct clip.mp4
# On GPUs, with NVIDIA's container toolkit: docker run --rm --gpus all -v ...
# The viewer, on Linux:       docker run --rm --network host ... nerfies view runs/NAME
FROM python:3.12-slim

ARG EXTRAS=all
# pip brings the CUDA libraries, so that the driver is all that the host needs.
ENV PIP_NO_CACHE_DIR=1 NVIDIA_DRIVER_CAPABILITIES=compute,utility
COPY pyproject.toml README.md LICENSE /src/
COPY nerfies_jax /src/nerfies_jax
COPY gaussians_jax /src/gaussians_jax
COPY experiments /src/experiments
RUN pip install "/src[${EXTRAS}]" && rm -r /src

WORKDIR /data
ENTRYPOINT ["nerfies"]
CMD ["--help"]
