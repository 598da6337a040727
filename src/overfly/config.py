"""Settings, every one with its unit in its name and its reason beside it. Unknown keys are refused in every
section.
"""

from __future__ import annotations

import hashlib
import json
from enum import StrEnum
from pathlib import Path
from typing import Any

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from overfly.errors import ConfigError


class AttitudeUse(StrEnum):
    """How roll and pitch of the attitude sensor are used."""

    PRIOR = "prior"  # a measurement with its standard deviation; the picture decides how much it counts
    FIXED = "fixed"  # the truth, as in the paper
    NONE = "none"  # not at all: the camera is taken to hang level, within level_sigma_deg


class Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class FeatureSettings(Section):
    """What is extracted from a picture."""

    extractor: str = Field(
        default="hessian-teblid", description="hessian-teblid, sift, orb, surf, surf-upright"
    )
    count: int = Field(
        default=400,
        ge=20,
        le=20_000,
        description="features of a picture 320 wide; grows with the square root of the width",
    )
    max_width_px: int = Field(
        default=1280, ge=80, description="wider pictures are reduced before anything is found in them"
    )


class RegistrationSettings(Section):
    """How a picture's pose is found from correspondences (paper, section IV)."""

    image_limit_px: float = Field(
        default=2.0,
        gt=0,
        description="reprojection limit of Eq. 4 in a picture 320 wide; scales with the width",
    )
    blend: float = Field(default=0.5, ge=0, le=1, description="alpha of Eq. 4")
    pairs_without_gain: int = Field(default=300, ge=1)
    max_pairs: int = Field(default=20_000, ge=1)
    min_inliers: int = Field(default=12, ge=4)
    min_spread: float = Field(
        default=0.08,
        ge=0,
        description="smallest RMS distance of the inliers from their middle, in picture widths",
    )
    localisation_px: float = Field(
        default=0.6, gt=0, description="standard deviation of a feature's place, in a picture 320 wide"
    )
    height_change: float = Field(
        default=2.0, gt=1, description="height over ground may differ by this factor from the last known one"
    )


class AttitudeSettings(Section):
    use: AttitudeUse = AttitudeUse.PRIOR
    level_sigma_deg: float = Field(
        default=3.0,
        gt=0,
        le=30,
        description="how level a camera hangs when no sensor says (blimp 2, helicopter 5)",
    )


class NodeSettings(Section):
    """When a frame becomes a node of the graph, and how many nodes a frame is compared with."""

    displacement: float = Field(
        default=0.20,
        gt=0,
        lt=1,
        description="moved by this share of the view's smaller side since the last node",
    )
    turn_deg: float = Field(default=25.0, gt=0, description="turned by this much since the last node")
    height_ratio: float = Field(
        default=1.25, gt=1, description="height changed by this factor since the last node"
    )
    overlap: float = Field(
        default=0.45,
        gt=0,
        lt=1,
        description="fewer than this share of the matches left that the last node began with",
    )
    previous: int = Field(
        default=3, ge=1, le=20, description="the paper's n: nodes that odometry compares with"
    )
    reuse_px: float = Field(
        default=2.0,
        ge=0,
        description="no new node where an older one agrees so well, in a picture 320 wide; 0: always one",
    )


class WindowSettings(Section):
    """Joint refinement of the newest nodes and the points they share."""

    nodes: int = Field(default=8, ge=0, le=50, description="newest nodes that are adjusted; 0 turns it off")
    fixed_nodes: int = Field(default=4, ge=0, le=50, description="older nodes that take part without moving")


class AdjustmentSettings(Section):
    """Joint refinement of the whole map and all points in it, when the flight is over."""

    enabled: bool = Field(default=True, description="off: the map ends as the pose graph has it")
    refine_camera: bool | None = Field(
        default=None,
        description="find focal length, centre and distortion too; one camera only; null: where only EXIF "
        "tells them",
    )


class TrackingSettings(Section):
    """Following points between nodes, without descriptors."""

    enabled: bool = Field(
        default=True, description="off: features are described and matched in every frame, as in the paper"
    )
    points: int = Field(default=200, ge=20, description="points that are followed at most")
    coarse_points: int = Field(
        default=80, ge=10, description="points that tell the motion since the last picture"
    )
    coarse_limit_px: float = Field(
        default=8.0, gt=0, description="how far they may disagree, in a picture 320 wide"
    )
    min_tracked: int = Field(default=20, ge=8, description="with fewer points left, descriptors are used")
    min_share: float = Field(
        default=0.5, gt=0, le=1, description="with a smaller share that agrees, descriptors are used"
    )
    localisation_px: float = Field(
        default=0.25,
        gt=0,
        description="standard deviation of a followed point's place while a frame is located, in a picture "
        "320 wide; in nodes each has its own",
    )


class RevisitSettings(Section):
    """When a place counts as seen before, and what that needs to be believed."""

    enabled: bool = Field(default=True, description="off: visual odometry alone, no loop is closed")
    sigmas: float = Field(
        default=3.0, gt=0, description="how far a pose may be from its estimate, in standard deviations"
    )
    away: int = Field(
        default=10, ge=2, description="newest nodes, which odometry ties, that do not count as seen before"
    )
    query_features: int = Field(
        default=60, ge=10, description="best features of a view that choose among the nodes"
    )
    lost_features: int = Field(
        default=200, ge=10, description="features that a lost camera searches the map with"
    )
    trees: int = Field(default=4, ge=1, le=16, description="search trees over all descriptors")
    comparisons: int = Field(
        default=400, ge=24, description="descriptors that one feature is compared with in the trees"
    )
    most_candidates: int = Field(
        default=40, ge=1, description="nodes that are searched one by one; the trees search more than that"
    )
    least_votes: int = Field(
        default=4, ge=1, description="features that nodes must have in common with the view"
    )
    group: int = Field(
        default=3, ge=1, description="neighbouring nodes that a view is registered with together"
    )
    most_groups: int = Field(default=4, ge=1, description="places that a view is registered with at most")
    min_inliers: int = Field(default=15, ge=6)
    min_spread: float = Field(
        default=0.04,
        ge=0,
        description="smallest deviation of the inliers from their middle, in picture widths",
    )
    tilt_sigmas: float = Field(
        default=4.0, gt=0, description="largest tilt against the sensor, in its standard deviations"
    )
    tilt_slack_deg: float = Field(
        default=1.0, ge=0, description="and on top, for a sensor that is not quite true"
    )
    wide_share: float = Field(
        default=0.3,
        gt=0,
        description="in picture widths: in a wider region a second revisit has to agree, unless strong",
    )
    strong_inliers: int = Field(default=40, ge=6, description="inliers of a revisit that needs no second one")
    strong_share: float = Field(default=0.5, gt=0, le=1, description="and their share of the matches")
    least_cover: float = Field(
        default=0.7,
        ge=0,
        le=1,
        description="part of the ground that both views see in which inliers lie, or it may be one object",
    )
    least_apart: float = Field(
        default=0.3,
        ge=0,
        description="flying heights between revisits that confirm each other: else they saw the same thing",
    )
    rival_share: float = Field(
        default=0.25,
        gt=0,
        le=1,
        description="with this share of its inliers another pose makes a revisit ambiguous",
    )
    most_waiting: int = Field(default=12, ge=1, description="revisits that wait for a second one at a time")
    least_gain: float = Field(
        default=2.0,
        gt=0,
        description="a constraint must know some direction so many times better than the map",
    )


class PieceSettings(Section):
    """When a new piece of the map begins because the camera is not found in the old one."""

    patience_s: float = Field(
        default=0.5,
        ge=0,
        description="how long ground is seen and not found before a new piece begins",
    )
    fewest_matches: int = Field(
        default=30, ge=6, description="that two frames have in common which see the same unknown ground"
    )


class HeightSettings(Section):
    """Where the scale comes from when there is neither stereo nor a range sensor."""

    given_m: float | None = Field(
        default=None, gt=0, description="height of the first frame above the ground"
    )


class MosaicSettings(Section):
    """How the finished map is drawn."""

    max_width_px: int = Field(
        default=2000,
        ge=80,
        description="wider pictures are reduced before they are laid on the ground; a quarter of the pixels "
        "takes a quarter of the time",
    )


class Config(Section):
    """All settings of map and locate."""

    features: FeatureSettings = FeatureSettings()
    registration: RegistrationSettings = RegistrationSettings()
    attitude: AttitudeSettings = AttitudeSettings()
    nodes: NodeSettings = NodeSettings()
    tracking: TrackingSettings = TrackingSettings()
    window: WindowSettings = WindowSettings()
    adjustment: AdjustmentSettings = AdjustmentSettings()
    revisit: RevisitSettings = RevisitSettings()
    pieces: PieceSettings = PieceSettings()
    height: HeightSettings = HeightSettings()
    mosaic: MosaicSettings = MosaicSettings()

    def hash(self) -> str:
        """Twelve hexadecimal digits that name this configuration in results."""
        text = json.dumps(self.model_dump(mode="json"), sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:12]

    def to_yaml(self) -> str:
        return yaml.safe_dump(self.model_dump(mode="json"), sort_keys=False)


def load_config(path: Path | None = None, assignments: list[str] | None = None) -> Config:
    """Defaults, then the YAML file, then each ``section.field=value``.

    Raises ConfigError, one line with the key, for what does not exist or does not fit.
    """
    tree: dict[str, Any] = {}
    if path is not None:
        try:
            tree = yaml.safe_load(path.read_text(encoding="utf-8")) or {}
        except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
            raise ConfigError(f"{path}: cannot be read as YAML: {str(error).splitlines()[0]}") from error
        if not isinstance(tree, dict):
            raise ConfigError(f"{path}: expected sections with settings, found {type(tree).__name__}")
    for assignment in assignments or []:
        key, equals, value = assignment.partition("=")
        section, dot, field = key.partition(".")
        if not (equals and dot and field):
            raise ConfigError(f"--set {assignment}: write section.field=value")
        if not isinstance(tree.setdefault(section, {}), dict):
            raise ConfigError(f"{path}: section {section} holds no settings")
        try:
            tree[section][field] = yaml.safe_load(value)
        except yaml.YAMLError as error:
            raise ConfigError(f"--set {assignment}: the value cannot be read") from error
    try:
        return Config.model_validate(tree)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        raise ConfigError(f"{where}: {first['msg']} (see overfly map --help and dump-config)") from error
