"""Feature extractors behind one interface; one extractor per file. The figures behind the choice are in
docs/features.md.

extractor = create_extractor("hessian-teblid", 500)
features = extractor.extract(gray)
"""

from __future__ import annotations

from collections.abc import Callable

from overfly.errors import ConfigError
from overfly.vision.features.interface import Extractor, Metric

DEFAULT_EXTRACTOR = "hessian-teblid"

__all__ = ["DEFAULT_EXTRACTOR", "EXTRACTOR_NAMES", "Extractor", "Metric", "create_extractor"]


def _hessian_teblid(count: int) -> Extractor:
    from overfly.vision.features.teblid import HessianTeblid

    return HessianTeblid(count)


def _hessian_teblid_upright(count: int) -> Extractor:
    from overfly.vision.features.teblid import HessianTeblid

    return HessianTeblid(count, upright=True)


def _sift(count: int) -> Extractor:
    from overfly.vision.features.sift import Sift

    return Sift(count)


def _orb(count: int) -> Extractor:
    from overfly.vision.features.orb import Orb

    return Orb(count)


def _surf(count: int) -> Extractor:
    from overfly.vision.features.surf import Surf

    return Surf(count)


def _surf_upright(count: int) -> Extractor:
    from overfly.vision.features.surf import Surf

    return Surf(count, upright=True)


_FACTORIES: dict[str, Callable[[int], Extractor]] = {
    "hessian-teblid": _hessian_teblid,
    "hessian-teblid-upright": _hessian_teblid_upright,
    "sift": _sift,
    "orb": _orb,
    "surf": _surf,
    "surf-upright": _surf_upright,
}

EXTRACTOR_NAMES = tuple(_FACTORIES)


def create_extractor(name: str = DEFAULT_EXTRACTOR, count: int = 500) -> Extractor:
    """An extractor of at most ``count`` features per image.

    name: one of EXTRACTOR_NAMES. Raises ConfigError for any other name and for a count below 1.
    """
    if name not in _FACTORIES:
        raise ConfigError(f"feature type {name!r} does not exist; choose one of {', '.join(EXTRACTOR_NAMES)}")
    if count < 1:
        raise ConfigError(f"feature count is {count}; it must be at least 1")
    return _FACTORIES[name](count)
