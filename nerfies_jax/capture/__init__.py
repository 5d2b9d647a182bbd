"""Captures: images, cameras and times of a scene, on the host in NumPy."""


def __getattr__(name):
    # Lazy, so that importing a room costs no decoder; a plain function here would hide
    # the reader's own signature.
    if name == "load":
        from nerfies_jax.capture.formats import load

        return load
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
