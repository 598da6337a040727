"""Pictures in ROS messages, as arrays."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from overfly.types import UInt8Array

_CHANNELS = {"mono8": 1, "8uc1": 1, "rgb8": 3, "bgr8": 3, "8uc3": 3, "rgba8": 4, "bgra8": 4}
_DEEP = ("mono16", "16uc1")
# ROS names the first two pixels of the first row, OpenCV those of the second row from its second column on.
_BAYER = {
    "bayer_rggb8": cv2.COLOR_BayerBG2RGB,
    "bayer_bggr8": cv2.COLOR_BayerRG2RGB,
    "bayer_gbrg8": cv2.COLOR_BayerGR2RGB,
    "bayer_grbg8": cv2.COLOR_BayerGB2RGB,
}
_YUV = {
    "yuv422": cv2.COLOR_YUV2RGB_UYVY,
    "uyvy": cv2.COLOR_YUV2RGB_UYVY,
    "yuv422_yuy2": cv2.COLOR_YUV2RGB_YUY2,
    "yuyv": cv2.COLOR_YUV2RGB_YUY2,
}


def decode_image(message: Any) -> UInt8Array | str:
    """sensor_msgs/Image or CompressedImage: (H, W) gray or (H, W, 3) RGB uint8, or what is wrong with it."""
    try:
        if hasattr(message, "encoding"):
            return _raw(message)
        return _compressed(message)
    except (ValueError, cv2.error):
        return "damaged picture"


def _raw(message: Any) -> UInt8Array | str:
    encoding = message.encoding.lower()
    height, width, data = int(message.height), int(message.width), np.asarray(message.data, dtype=np.uint8)
    if encoding in _DEEP:
        order = ">u2" if message.is_bigendian else "<u2"
        deep = _rows(data, height, message.step, 2 * width).copy().view(order)
        return (deep >> 8).astype(np.uint8)
    if encoding in _BAYER:
        mosaic = np.ascontiguousarray(_rows(data, height, message.step, width))
        return np.asarray(cv2.cvtColor(mosaic, _BAYER[encoding]), dtype=np.uint8)
    if encoding in _YUV:
        pairs = np.ascontiguousarray(_rows(data, height, message.step, 2 * width))
        return np.asarray(cv2.cvtColor(pairs.reshape(height, width, 2), _YUV[encoding]), dtype=np.uint8)
    channels = _CHANNELS.get(encoding)
    if channels is None:
        return f"encoding {message.encoding} is not known"
    rows = _rows(data, height, message.step, channels * width)
    if channels == 1:
        return np.ascontiguousarray(rows)
    pixels = rows.reshape(height, width, channels)[:, :, :3]
    is_bgr = encoding.startswith("bgr") or encoding == "8uc3"
    return np.ascontiguousarray(pixels[:, :, ::-1] if is_bgr else pixels)


def _rows(data: UInt8Array, height: int, step: int, wanted: int) -> UInt8Array:
    """(H, wanted) bytes of the rows, without what pads them. Raises ValueError when there are too few."""
    step = int(step) or wanted
    if height <= 0 or step < wanted or len(data) < height * step:
        raise ValueError("fewer bytes than pixels")
    return data[: height * step].reshape(height, step)[:, :wanted]


def _compressed(message: Any) -> UInt8Array | str:
    image = cv2.imdecode(np.asarray(message.data, dtype=np.uint8), cv2.IMREAD_UNCHANGED)
    if image is None:
        return "damaged picture"
    if image.dtype == np.uint16:
        image = np.asarray(image // 256, dtype=np.uint8)
    if image.ndim == 2:
        return np.ascontiguousarray(image, dtype=np.uint8)
    return np.ascontiguousarray(image[:, :, 2::-1], dtype=np.uint8)
