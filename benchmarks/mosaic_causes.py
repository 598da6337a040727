"""What a mosaic is displaced by: the whole, its scale, the poses of its cameras, or the drawing.

python benchmarks/mosaic_causes.py OUT FLIGHT [OUT FLIGHT ...]

OUT: a folder that `overfly map` left; FLIGHT: the simulated flight it was made from, with its truth. Corners
of the mosaic are found again in the true orthophoto (mosaic_accuracy.py), the map laid on the truth as its
cameras lie. What is left of their displacements, in pixels, is told after more and more is taken off: the
rigid motion of the plane that fits best; the similarity; all that is alike within a few metres; and, from the
first, just what the error of the pose of each place's camera moves it by, which has no free parameter. Last,
the mosaic is drawn again with the truth's poses on the true surface.
"""

from __future__ import annotations

import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import rasterio
from mosaic_accuracy import Truth, laid_on_ground, mosaic_displacements
from scipy.spatial import cKDTree

from overfly.evaluation import Align, Evaluation, Similarity, evaluate
from overfly.geometry.poses import FloatArray, Pose
from overfly.mapstore import Map
from overfly.pipeline.node_pictures import KeptPictures, NodePictures
from overfly.products.elevation import ElevationGrid, read_elevation
from overfly.products.georeference import GeoReference, transform_points
from overfly.products.mosaic import MOST_OVERLAP, write_mosaic
from overfly.products.views import MappedImage, spread_out, view_of
from overfly.sensors import open_flight
from overfly.trajectory import read_tum

NEIGHBOURS = 40  # corners, whose median displacement is that of the place


@dataclass(frozen=True)
class Mapped:
    """A map beside its truth. images: of the nodes, with the map's poses; true_poses: of the same."""

    known: Map
    fitted: Evaluation
    truth: Truth
    ground: ElevationGrid
    images: list[MappedImage]
    true_poses: list[Pose]

    @property
    def reference(self) -> GeoReference:
        return self.known.georeference or GeoReference.local()

    @staticmethod
    def read(out: Path, flight: Path) -> Mapped:
        known = Map.open(out / "map.overfly")
        estimate = read_tum(out / "trajectory.tum")
        fitted = evaluate(estimate, read_tum(flight / "truth" / "groundtruth_cam0.tum"), Align.SE3)
        pictures = NodePictures(
            open_flight(flight), KeptPictures(known.config.mosaic.max_width_px), known.rig
        )
        place_of = {int(stamp): n for n, stamp in enumerate(fitted.estimate.t_ns)}
        images, true_poses = [], []
        for entry in known.frames:
            if entry.made_node and entry.node is not None and entry.t_ns in place_of:
                pose = known.visual.graph.pose(entry.node)
                load = pictures.first_loader(entry.frame_index)
                images.append(MappedImage(str(entry.frame_index), load, pictures.rig.cam0.camera, pose))
                true_poses.append(fitted.truth.pose(place_of[entry.t_ns]))
        ground = read_elevation(out / "elevation.tif", known.georeference)
        return Mapped(known, fitted, Truth.read(flight / "truth" / "scene"), ground, images, true_poses)


def moved_by_poses(mapped: Mapped, corners: FloatArray, path: Path) -> FloatArray:
    """(k, 2) pixels by which the pose errors of the nearest cameras displace corners (k, 2) of the mosaic."""
    with rasterio.open(path) as raster:
        world_from_pixel = ~mapped.reference.crs_from_world() @ raster.transform
    ground = mapped.ground.extended()
    views = [view_of(image, ground, ground.height_range_m()) for image in mapped.images]
    index_of = {id(view): n for n, view in enumerate(views)}
    drawn = [index_of[id(view)] for view in spread_out([v for v in views if v is not None], MOST_OVERLAP)]
    plane = transform_points(world_from_pixel, corners)
    world = np.column_stack([plane, ground.height_at(*plane.T)])
    centres = np.array([mapped.images[n].world_from_cam.translation for n in drawn])
    nearest = np.asarray(drawn)[cKDTree(centres).query(world)[1]]
    to_truth = mapped.fitted.truth_from_estimate
    there = to_truth.transform(world)
    for n in np.unique(nearest):
        mine = nearest == n
        pose, true = mapped.images[n].world_from_cam, mapped.true_poses[n]
        rays = (world[mine] - pose.translation) @ pose.rotation @ true.rotation.T
        height = mapped.truth.height_at(*there[mine, :2].T)
        reach = (height - true.translation[2]) / rays[:, 2]
        there[mine] = true.translation + reach[:, None] * rays
    back = inverse(to_truth).transform(there)
    return transform_points(~world_from_pixel, back[:, :2]) - corners


def inverse(one: Similarity) -> Similarity:
    rotation = one.rotation.T
    return Similarity(1.0 / one.scale, rotation, -rotation @ one.translation / one.scale)


def alike_taken_off(places: FloatArray, shifts: FloatArray) -> FloatArray:
    """(k, 2) shifts less the median of those around."""
    _, around = cKDTree(places).query(places, min(NEIGHBOURS, len(places)))
    return shifts - np.median(shifts[around], axis=1)


def true_surface(truth: Truth) -> ElevationGrid:
    heights = truth.dsm.astype(np.float32)
    return ElevationGrid(
        truth.dsm_x0 - truth.cell_m / 2, truth.dsm_y1 + truth.cell_m / 2, truth.cell_m,
        heights, np.zeros_like(heights),
    )  # fmt: skip


def drawn_with_true_poses(mapped: Mapped, gsd_m: float) -> FloatArray:
    """(k, 2) displacements of a mosaic drawn with the truth's poses on the true surface."""
    surface = true_surface(mapped.truth)
    images = [
        MappedImage(image.name, image.load, image.camera, pose)
        for image, pose in zip(mapped.images, mapped.true_poses, strict=True)
    ]
    same = Similarity(1.0, np.eye(3), np.zeros(3))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "mosaic.tif"
        write_mosaic(path, images, surface, gsd_m)
        return mosaic_displacements(path, GeoReference.local(), surface, same, mapped.truth)[1]


def told(name: str, shifts: FloatArray) -> None:
    length = np.linalg.norm(shifts, axis=1)
    print(f"  {name:42s} median {np.median(length):6.2f} px, 95 % {np.percentile(length, 95):6.2f} px")


def main() -> None:
    for out, flight in zip(sys.argv[1::2], sys.argv[2::2], strict=True):
        mapped = Mapped.read(Path(out), Path(flight))
        path = Path(out) / "mosaic.tif"
        with rasterio.open(path) as raster:
            gsd_m = abs(raster.transform.a) / mapped.reference.scale
        corners, shifts, share = mosaic_displacements(
            path, mapped.reference, mapped.ground, mapped.fitted.truth_from_estimate, mapped.truth
        )
        ate = mapped.fitted.ate_horizontal_m.rmse
        print(f"{Path(flight).name}: {1e3 * gsd_m:.1f} mm/px, horizontal ATE {1e3 * ate:.1f} mm "
              f"= {ate / gsd_m:.1f} px, {len(corners)} corners, {share:.0%} found again")  # fmt: skip
        told("as the cameras lie", shifts)
        told("rigid motion of the plane taken off", laid_on_ground(corners, shifts, with_scale=False))
        told("similarity taken off", laid_on_ground(corners, shifts, with_scale=True))
        told("what is alike around taken off", alike_taken_off(corners, shifts))
        told("errors of the cameras' poses taken off", shifts - moved_by_poses(mapped, corners, path))
        told("drawn with true poses on the true surface", drawn_with_true_poses(mapped, gsd_m))


if __name__ == "__main__":
    main()
