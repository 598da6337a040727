"""What OpenCV alone, and COLMAP where it is installed, offer from picture to picture: the yardsticks of
overfly bench.

No map, no graph, no scale.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from importlib.metadata import version
from importlib.util import find_spec

import cv2
import numpy as np

from overfly.geometry.cameras import Camera
from overfly.geometry.poses import FloatArray
from overfly.types import UInt8Array
from overfly.vision.observation import working_image

FEATURES = 500
LEAST_PAIRS = 8
RANSAC_PX = 2.0

Alternative = Callable[[Sequence[UInt8Array], Camera], int]


def orb_homography(images: Sequence[UInt8Array], camera: Camera) -> int:
    """ORB, brute-force matches, homography by RANSAC; returns how many steps were found."""
    return _described(cv2.ORB.create(FEATURES), cv2.NORM_HAMMING, images, camera)


def sift_homography(images: Sequence[UInt8Array], camera: Camera) -> int:
    """SIFT, brute-force matches, homography by RANSAC; returns how many steps were found."""
    return _described(cv2.SIFT.create(FEATURES), cv2.NORM_L2, images, camera)


def flow_essential(images: Sequence[UInt8Array], camera: Camera) -> int:
    """Corners, pyramidal Lucas-Kanade, essential matrix and its pose; returns how many steps were found."""
    found = 0
    matrix = camera.matrix()
    before: UInt8Array | None = None
    for image in images:
        gray = working_image(image, camera)
        if before is not None:
            corners = cv2.goodFeaturesToTrack(before, FEATURES, 0.01, 7.0)
            if corners is not None:
                there, status, _ = cv2.calcOpticalFlowPyrLK(before, gray, corners, np.empty_like(corners))
                good = status.ravel() == 1
                found += _has_pose(corners[good].reshape(-1, 2), there[good].reshape(-1, 2), matrix)
        before = gray
    return found


def colmap_homography(images: Sequence[UInt8Array], camera: Camera) -> int:
    """COLMAP's SIFT, matches and homography, on one thread; returns how many steps were found."""
    import pycolmap

    pycolmap.logging.minloglevel = 2  # it tells of every extractor that it makes
    options = pycolmap.FeatureExtractionOptions(use_gpu=False, num_threads=1)
    options.sift.max_num_features = FEATURES
    extractor = pycolmap.FeatureExtractor.create(options, pycolmap.Device.cpu)
    matching = pycolmap.FeatureMatchingOptions(use_gpu=False, num_threads=1)
    matcher = pycolmap.FeatureMatcher.create(matching, pycolmap.Device.cpu)
    limits = pycolmap.RANSACOptions(max_error=RANSAC_PX)
    found = 0
    before = None
    for image in images:
        now = extractor.extract(pycolmap.Bitmap.from_array(working_image(image, camera)))
        if before is not None:
            pairs = matcher.match(*before, *now).astype(int)
            a = np.array([[before[0][i].x, before[0][i].y] for i in pairs[:, 0]])
            b = np.array([[now[0][i].x, now[0][i].y] for i in pairs[:, 1]])
            enough = len(pairs) >= LEAST_PAIRS
            found += enough and pycolmap.estimate_homography_matrix(a, b, limits) is not None
        before = now
    return found


def _has_colmap() -> bool:
    """Whether a pycolmap is installed that extracts features from pictures in memory as this one does."""
    return find_spec("pycolmap") is not None and int(version("pycolmap").split(".")[0]) >= 4


ALTERNATIVES: dict[str, Alternative] = {
    "OpenCV ORB + homography": orb_homography,
    "OpenCV SIFT + homography": sift_homography,
    "OpenCV flow + essential matrix": flow_essential,
    **({"COLMAP SIFT + homography": colmap_homography} if _has_colmap() else {}),
}


def _described(extractor: cv2.Feature2D, norm: int, images: Sequence[UInt8Array], camera: Camera) -> int:
    matcher = cv2.BFMatcher(norm, crossCheck=True)
    found = 0
    before = None
    for image in images:
        keypoints, descriptors = extractor.detectAndCompute(working_image(image, camera), None)
        now = cv2.KeyPoint.convert(keypoints), descriptors
        if before is not None and before[1] is not None and descriptors is not None:
            matches = matcher.match(before[1], descriptors)
            if len(matches) >= LEAST_PAIRS:
                a = np.array([before[0][match.queryIdx] for match in matches])
                b = np.array([now[0][match.trainIdx] for match in matches])
                homography, _ = cv2.findHomography(a, b, cv2.RANSAC, RANSAC_PX)
                found += homography is not None
        before = now
    return found


def _has_pose(a: FloatArray, b: FloatArray, matrix: FloatArray) -> bool:
    if len(a) < LEAST_PAIRS:
        return False
    essential, inliers = cv2.findEssentialMat(a, b, matrix, cv2.RANSAC, 0.999, 1.0)
    if essential is None or essential.shape != (3, 3):
        return False
    return bool(cv2.recoverPose(essential, a, b, matrix, mask=inliers)[0])
