"""What overfly info says of a map file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from overfly.graph.pose_graph import KINDS
from overfly.mapstore import Map
from overfly.types import ConstraintKind


def is_map_file(path: Path) -> bool:
    """Whether a path is a file that calls itself a map; flights are folders."""
    return path.is_file() and path.suffix == ".overfly"


def as_dictionary(known: Map) -> dict[str, Any]:
    """What the map holds, in JSON's types."""
    graph = known.visual.graph
    low, high = (
        (graph.positions.min(axis=0), graph.positions.max(axis=0))
        if len(known)
        else (np.zeros(3), np.zeros(3))
    )
    reference = known.georeference
    return {
        "map": str(known.path),
        "nodes": len(known),
        "features": known.n_features,
        "constraints": graph.n_constraints,
        "revisits": int((graph.kinds == KINDS.index(ConstraintKind.REVISIT)).sum()),
        "constraints_rejected": int(graph.n_constraints - len(graph.active)),
        "extent_m": (high - low).tolist(),
        "features_type": known.config.features.extractor,
        "scale_source": known.scale_source,
        "crs": None if reference is None else reference.crs,
        "flights": [
            {
                "source": flight.source,
                "created": flight.created,
                "software": flight.software,
                "complete": flight.complete,
                "frames": sum(frame.flight == flight.number for frame in known.frames),
                "located": sum(
                    frame.flight == flight.number and frame.node is not None for frame in known.frames
                ),
                "nodes": known.node_flights.count(flight.number),
                "cameras": [
                    f"{mounted.name} {mounted.camera.width}x{mounted.camera.height}"
                    for mounted in flight.rig.cameras
                ],
                "config_hash": flight.config.hash(),
            }
            for flight in known.flights
        ],
    }


def as_text(known: Map) -> str:
    """The same for a terminal."""
    facts = as_dictionary(known)
    wide, long, _ = facts["extent_m"]
    lines = [
        f"{known.path}: map of {len(known.flights)} flight{'s' if len(known.flights) > 1 else ''}",
        f"  nodes            {facts['nodes']}, with {facts['features']} features ({facts['features_type']})",
        f"  constraints      {facts['constraints']}, of them {facts['revisits']} revisits, "
        f"{facts['constraints_rejected']} rejected",
        f"  extent           {wide:.1f} x {long:.1f} m",
        f"  scale from       {facts['scale_source']}",
        f"  place on Earth   {facts['crs'] or 'not known'}",
    ]
    for flight in facts["flights"]:
        state = "" if flight["complete"] else ", broken off: overfly map ... --resume carries on"
        lines += [
            f"  flight           {flight['source']}, {', '.join(flight['cameras'])}",
            f"                   {flight['located']} of {flight['frames']} frames located, "
            f"{flight['nodes']} nodes; {flight['created']}, {flight['software']}{state}",
        ]
    return "\n".join(lines)
