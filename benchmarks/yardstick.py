"""What a front-end of OpenCV's calls alone takes, ms a frame: ``python benchmarks/yardstick.py DATA``."""

import sys
from pathlib import Path
from time import perf_counter
from typing import Any

import cv2
import numpy as np

from vioframe.frontend import FrontendOptions
from vioframe.parts import registry
from vioframe.types import FrameSet

_LEVELS, _WINDOW = 4, (15, 15)
follow: Any = cv2.calcOpticalFlowPyrLK  # it takes a guess or None, of which its types do not know


def main(data: Path) -> None:
    """Decoded by the reader; then no line of vioframe's."""
    cv2.setNumThreads(1)
    dataset = registry.load().open_dataset(data, options={"cameras": ["cam0"]})
    camera = dataset.calibration.cameras[0].model
    K = np.array([[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]])
    most, equalise = FrontendOptions().max_points, cv2.createCLAHE(3.0, (8, 8))
    before, xy = None, np.empty((0, 1, 2), np.float32)
    frames, begin_s = 0, perf_counter()
    for measurement in dataset.measurements():
        if not isinstance(measurement, FrameSet) or measurement.images[0] is None:
            continue
        frames += 1
        image = equalise.apply(measurement.images[0])
        if len(xy) > 8:
            now, ok, _ = follow(before, image, xy, None, winSize=_WINDOW, maxLevel=_LEVELS)
            back, ok_back, _ = follow(image, before, now, None, winSize=_WINDOW, maxLevel=_LEVELS)
            good = (ok & ok_back).ravel().astype(bool) & (np.abs(back - xy).max(axis=(1, 2)) < 1.0)
            if good.sum() > 8:
                mask = cv2.findEssentialMat(xy[good], now[good], K, cv2.USAC_MAGSAC, 0.99, 1.0)[1]
                xy = now[good][mask.ravel().astype(bool)] if mask is not None else now[good]
        if len(xy) < 0.9 * most:
            free = np.full(image.shape, 255, np.uint8)
            for x, y in xy.reshape(-1, 2):
                cv2.circle(free, (round(float(x)), round(float(y))), 20, 0, -1)
            new = cv2.goodFeaturesToTrack(image, most - len(xy), 0.01, 20, mask=free)
            xy = xy if new is None else np.concatenate([xy.reshape(-1, 1, 2), new])
        before = image
    print(1e3 * (perf_counter() - begin_s) / frames)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
