"""What a made-up camera sees: a papered wall two metres ahead, and things before it."""

import io

import numpy as np
from PIL import Image as Picture
from surprised_proto import Frame, Image

WIDTH, HEIGHT = 160, 120
FOCAL = 150.0
# x_min, y_min, x_max, y_max; at whole blocks of evidence.
BOX = (64, 40, 104, 80)


def wall() -> np.ndarray:
    """rgb8, HxWx3. Patches of eight pixels: enough texture to align poses by."""
    paper = np.random.default_rng(1).integers(60, 180, (HEIGHT // 8, WIDTH // 8, 3), np.uint8)
    return np.kron(paper, np.ones((8, 8, 1), np.uint8))


def look(box=None) -> tuple[np.ndarray, np.ndarray]:
    """rgb8 and depth in metres, with a red box before the wall where `box` says."""
    rgb, depth_m = wall(), np.full((HEIGHT, WIDTH), 2.0, np.float32)
    if box:
        x_min, y_min, x_max, y_max = box
        rgb[y_min:y_max, x_min:x_max] = (200, 20, 20)
        depth_m[y_min:y_max, x_min:x_max] = 1.9
    return rgb, depth_m


def frame(sequence: int, stamp_ns: int, box=None) -> Frame:
    """A frame that nothing is wrong with."""
    rgb, depth_m = look(box)
    message = Frame(
        sequence=sequence,
        image=Image(encoding="rgb8", width=WIDTH, height=HEIGHT, data=rgb.tobytes()),
        depth=Image(encoding="32FC1", width=WIDTH, height=HEIGHT, data=depth_m.tobytes()),
    )
    message.stamp.FromNanoseconds(stamp_ns)
    message.world_from_camera.position.z = 1.0
    message.world_from_camera.orientation.w = 1.0
    lens = message.calibration.middle
    lens.width, lens.height = WIDTH, HEIGHT
    lens.fx, lens.fy, lens.cx, lens.cy = FOCAL, FOCAL, (WIDTH - 1) / 2, (HEIGHT - 1) / 2
    return message


def picture_file(pixels: np.ndarray, kind: str) -> bytes:
    """A whole jpeg or png file."""
    out = io.BytesIO()
    Picture.fromarray(pixels).save(out, kind, **({"quality": 95} if kind == "jpeg" else {}))
    return out.getvalue()


def overlap(box, other) -> float:
    """Intersection over union of half-open boxes."""

    def area(b):
        return max(0, b[2] - b[0]) * max(0, b[3] - b[1])

    both = area(tuple(f(a, b) for f, a, b in zip((max, max, min, min), box, other)))
    union = area(box) + area(other) - both
    return both / union if union else 0.0


def corners(box) -> tuple[int, int, int, int]:
    """Of a `Box` message."""
    return box.x_min, box.y_min, box.x_max, box.y_max
