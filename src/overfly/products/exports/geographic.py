"""The camera's track on Earth: GeoJSON (RFC 7946), KML 2.2 and GPX 1.1, all in WGS 84."""

from __future__ import annotations

import json
from datetime import UTC, datetime, timedelta
from pathlib import Path
from xml.sax.saxutils import escape

import numpy as np
from pyproj import Transformer

from overfly.files import atomic_path
from overfly.geometry.poses import FloatArray
from overfly.products.georeference import GeoReference, transform_points
from overfly.trajectory import Trajectory
from overfly.types import IntArray

EARLIEST_CLOCK_NS = 315_964_800 * 1_000_000_000  # 1980, when GPS time begins: smaller stamps are no dates


def geodetic_of(points: FloatArray, reference: GeoReference) -> FloatArray:
    """points (n, 3) metres, world -> (n, 3) longitude, latitude (degrees), altitude (m), as GPS gave it."""
    east_north = transform_points(reference.crs_from_world(), points[:, :2])
    transformer = Transformer.from_crs(reference.crs, 4326, always_xy=True)
    longitude, latitude = transformer.transform(east_north[:, 0], east_north[:, 1])
    return np.column_stack([longitude, latitude, reference.height_in_crs(points[:, 2])])


def utc_texts(t_ns: IntArray) -> list[str]:
    """ISO 8601 times to the microsecond; empty when the stamps count from no known day."""
    if len(t_ns) and int(t_ns[0]) < EARLIEST_CLOCK_NS:
        return []
    start = datetime(1970, 1, 1, tzinfo=UTC)
    return [(start + timedelta(microseconds=int(t) // 1000)).isoformat().replace("+00:00", "Z") for t in t_ns]


def write_geojson(path: Path, name: str, trajectory: Trajectory, reference: GeoReference) -> None:
    """One LineString with the times of its points in ``coordTimes``. Raises OutputError."""
    rows = geodetic_of(trajectory.positions, reference)
    properties: dict[str, object] = {"name": name, "t_ns": [int(t) for t in trajectory.t_ns]}
    times = utc_texts(trajectory.t_ns)
    if times:
        properties["coordTimes"] = times
    coordinates = [[round(x, 9), round(y, 9), round(z, 3)] for x, y, z in rows.tolist()]
    # a line has two ends: a single place is a point
    geometry = (
        {"type": "LineString", "coordinates": coordinates}
        if len(coordinates) > 1
        else {"type": "Point", "coordinates": coordinates[0]}
    )
    feature = {"type": "Feature", "properties": properties, "geometry": geometry}
    tree = {"type": "FeatureCollection", "features": [feature]}
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(tree) + "\n", encoding="utf-8")


def write_kml(path: Path, name: str, trajectory: Trajectory, reference: GeoReference) -> None:
    """A Placemark with a LineString at absolute altitude. Raises OutputError."""
    rows = geodetic_of(trajectory.positions, reference)
    coordinates = " ".join(f"{x:.9f},{y:.9f},{z:.3f}" for x, y, z in rows)
    text = (
        '<?xml version="1.0" encoding="UTF-8"?>\n'
        '<kml xmlns="http://www.opengis.net/kml/2.2"><Document>'
        f"<name>{escape(name)}</name>"
        '<Style id="track"><LineStyle><color>ffb86816</color><width>3</width></LineStyle></Style>'
        f"<Placemark><name>{escape(name)}</name><styleUrl>#track</styleUrl><LineString>"
        "<altitudeMode>absolute</altitudeMode>"
        f"<coordinates>{coordinates}</coordinates>"
        "</LineString></Placemark></Document></kml>\n"
    )
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_gpx(path: Path, name: str, trajectory: Trajectory, reference: GeoReference) -> None:
    """One track segment, with times where the stamps are dates. Raises OutputError."""
    rows = geodetic_of(trajectory.positions, reference)
    dates = utc_texts(trajectory.t_ns)
    times = [f"<time>{date}</time>" for date in dates] or [""] * len(rows)
    points = "\n".join(
        f'<trkpt lat="{y:.9f}" lon="{x:.9f}"><ele>{z:.3f}</ele>{time}</trkpt>'
        for (x, y, z), time in zip(rows, times, strict=True)
    )
    text = (
        '<?xml version="1.0" encoding="UTF-8"?>\n'
        '<gpx version="1.1" creator="Overfly" xmlns="http://www.topografix.com/GPX/1/1">\n'
        f"<trk><name>{escape(name)}</name><trkseg>\n{points}\n</trkseg></trk></gpx>\n"
    )
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
