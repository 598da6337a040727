"""From correspondences to a camera pose with its covariance: pair search, then refinement on the inliers
(section IV).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from overfly.config import AttitudeUse, Config
from overfly.geometry.cameras import Camera
from overfly.geometry.levelling import level_from_cam
from overfly.geometry.poses import FloatArray, Pose
from overfly.types import Attitude, Correspondences, NotFound, PoseEstimate, Reason, Rig
from overfly.vision.pair_search import SearchSettings, search_pairs
from overfly.vision.refine import HeightPrior, TiltPrior, refine_pose

FIXED_SIGMA_RAD = 1e-5  # so small that the sensor is the truth, as in the paper
REFERENCE_WIDTH_PX = 320  # of the paper's pictures, to which limits in pixels refer
TILT_DISTORTION = (
    0.3  # (half the view)^2: how much of a tilt error is left after shift and yaw have taken their part
)


@dataclass(frozen=True, slots=True, eq=False)
class Registrar:
    """All that registration needs to know about one camera and the user's settings."""

    camera: Camera
    body_from_cam: FloatArray
    config: Config
    descriptor_limit: float
    rig_level_sigma_rad: float | None = None

    def knows_tilt(self, attitude: Attitude | None) -> bool:
        """Whether a sensor measured roll and pitch, and they are to be used."""
        return attitude is not None and self.config.attitude.use is not AttitudeUse.NONE

    def tilt_prior(self, attitude: Attitude | None) -> TiltPrior:
        """What is known of roll and pitch before the picture is looked at."""
        use = self.config.attitude.use
        if attitude is None or not self.knows_tilt(attitude):
            sigma = self.rig_level_sigma_rad or math.radians(self.config.attitude.level_sigma_deg)
            return TiltPrior(
                level_from_cam(None, self.body_from_cam),
                FIXED_SIGMA_RAD if use is AttitudeUse.FIXED else sigma,
            )
        sigma = FIXED_SIGMA_RAD if use is AttitudeUse.FIXED else max(attitude.sigma_rad, 1e-4)
        return TiltPrior(level_from_cam(attitude, self.body_from_cam), sigma)

    def pixels(self, at_reference_width: float) -> float:
        """A length in pixels of a picture 320 wide, in units of this camera's focal length."""
        return at_reference_width * self.camera.width / REFERENCE_WIDTH_PX / self.camera.focal_px

    def limits(self, tilt: TiltPrior) -> tuple[float, float]:
        """Reprojection limits of the search and of the final inliers, in units of the focal length.

        The search takes the measured tilt as truth, so its limit leaves room for the sensor's error.
        """
        final = self.pixels(self.config.registration.image_limit_px)
        return final + 1.5 * TILT_DISTORTION * tilt.sigma_rad, final

    def register(
        self,
        correspondences: Correspondences,
        attitude: Attitude | None,
        height_range_m: tuple[float, float],
        height: HeightPrior | None = None,
    ) -> PoseEstimate | NotFound:
        """The camera's pose in the frame of the correspondences' points, or why there is none."""
        settings = self.config.registration
        if len(correspondences) < settings.min_inliers:
            return NotFound(Reason.FEW_MATCHES, f"{len(correspondences)} matches")
        tilt = self.tilt_prior(attitude)
        search_limit, _ = self.limits(tilt)
        hypothesis = search_pairs(
            correspondences,
            tilt.level_from_cam,
            SearchSettings(
                image_limit=search_limit,
                image_sigma=self.pixels(settings.localisation_px),
                descriptor_limit=self.descriptor_limit,
                blend=settings.blend,
                max_pairs=settings.max_pairs,
                pairs_without_gain=settings.pairs_without_gain,
                height_range_m=height_range_m,
            ),
        )
        if hypothesis is None:
            return NotFound(Reason.NO_HYPOTHESIS, f"{len(correspondences)} matches")
        return self.refine(hypothesis.world_from_cam, correspondences, tilt, height, hypothesis.score)

    def refine(
        self,
        start: Pose,
        correspondences: Correspondences,
        tilt: TiltPrior,
        height: HeightPrior | None,
        score: float,
        localisation_px: float | None = None,
    ) -> PoseEstimate | NotFound:
        """Refine a pose that is nearly right and decide whether it may be believed."""
        settings = self.config.registration
        refined = refine_pose(
            start,
            correspondences.points,
            correspondences.rays,
            self.pixels(localisation_px or settings.localisation_px),
            self.limits(tilt),
            tilt,
            height,
            correspondences.spread,
        )
        if refined is None:
            return NotFound(Reason.FEW_INLIERS, "fewer than 4 inliers")
        inliers = np.flatnonzero(refined.inliers)
        distinct = int(np.count_nonzero(np.bincount(correspondences.frame_index[inliers])))
        if distinct < settings.min_inliers:
            return NotFound(Reason.FEW_INLIERS, f"{distinct} inliers of {len(correspondences)} matches")
        seen = correspondences.rays[inliers]
        spread = math.sqrt(float(((seen - seen.mean(axis=0)) ** 2).sum(axis=1).mean()))
        if spread < settings.min_spread * self.camera.width / self.camera.focal_px:
            return NotFound(Reason.POOR_SPREAD, f"{distinct} inliers in a corner of the picture")
        return PoseEstimate(
            refined.world_from_cam,
            refined.covariance,
            inliers,
            score,
            refined.rms * self.camera.focal_px,
        )


def create_registrar(rig: Rig, config: Config, descriptor_limit: float) -> Registrar:
    """The registrar of a rig's first camera."""
    cam0 = rig.cam0
    return Registrar(cam0.camera, cam0.body_from_cam.rotation, config, descriptor_limit, rig.level_sigma_rad)
