"""A clip whose cameras COLMAP can find: two textured planes before a moving camera."""

import pathlib

import numpy as np

SIZE, FOCAL, COUNT = (240, 180), 220.0, 8


def write(folder: pathlib.Path) -> None:
    """Write the images of the clip into a new folder."""
    from nerfies_jax.capture.images import write_png
    from nerfies_jax.capture.json_files import new_folder
    from nerfies_jax.geometry import camera

    random = np.random.default_rng(0)
    textures = [_texture(random) for _ in range(2)]
    with new_folder(folder) as partial:
        for row in range(COUNT):
            place = [0.9 * np.sin(0.5 * row), -0.4 * np.cos(0.7 * row), 0.1 * row]
            one = camera.look_at(place, [0.1, 0, 3.5], [0, -1, 0], FOCAL, SIZE)
            write_png(partial / f"{row:02d}.png", _render(one, textures))


def _texture(random):
    import cv2

    noise = random.normal(size=(200, 200)).astype(np.float32)
    return 128 + 60 * cv2.resize(noise, (800, 800)).clip(-2, 2)


def _render(one, textures):
    """Planes at z = 4 and, for positive x, at z = 3."""
    import cv2

    width, height = SIZE
    y, x = np.mgrid[:height, :width] + 0.5
    inner = np.stack([(x - width / 2) / FOCAL, (y - height / 2) / FOCAL, x * 0 + 1], -1)
    ray = inner @ np.asarray(one.camera_from_world, float)
    position = np.asarray(one.position, float)
    image = None
    for depth, texture in zip((4.0, 3.0), textures, strict=True):
        hit = position + ((depth - position[2]) / ray[..., 2])[..., None] * ray
        place = (hit[..., :2] * 90 + 400).astype(np.float32)
        seen = cv2.remap(
            texture, place[..., 0], place[..., 1], cv2.INTER_LINEAR, None, 2
        )
        front = hit[..., 0] > 0
        image = seen if image is None else np.where(front, seen, image)
    return np.repeat(np.clip(image, 0, 255).astype(np.uint8)[..., None], 3, -1)
