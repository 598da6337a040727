"""Text as people and recorders write it: UTF-8, byte-order mark or not, Latin-1, any line ending."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from overfly.errors import CalibrationError, SourceError


def read_text(path: Path) -> str:
    """Contents of a text file. Raises SourceError when it cannot be read."""
    try:
        raw = path.read_bytes()
    except OSError as error:
        raise SourceError(
            f"{path}: cannot be read ({error.strerror}); check that it exists and may be read"
        ) from error
    try:
        return raw.decode("utf-8-sig")
    except UnicodeDecodeError:
        return raw.decode("latin-1")


class _Loader(yaml.SafeLoader):
    """Safe YAML that also knows the matrix tag of OpenCV's FileStorage."""


def _matrix(loader: yaml.SafeLoader, node: yaml.Node) -> object:
    if not isinstance(node, yaml.MappingNode):
        raise yaml.constructor.ConstructorError(
            None, None, "a matrix must have rows, cols and data", node.start_mark
        )
    return loader.construct_mapping(node, deep=True)


_Loader.add_constructor("tag:yaml.org,2002:opencv-matrix", _matrix)


def read_yaml(path: Path) -> dict[str, Any]:
    """Top-level mapping of a YAML file, OpenCV's dialect too. Raises CalibrationError when it is not one."""
    # OpenCV opens with "%YAML:1.0", which only its own parser accepts
    lines = [line for line in read_text(path).splitlines() if not line.startswith("%")]
    try:
        content = yaml.load("\n".join(lines).replace("\t", " "), Loader=_Loader)  # a SafeLoader
    except (yaml.YAMLError, ValueError, RecursionError) as error:  # ValueError: a date or number out of range
        mark = getattr(error, "problem_mark", None)
        place = f"line {mark.line + 1}" if mark else "its contents"
        raise CalibrationError(
            f"{path}: not readable as YAML ({place}); repair it or export it again"
        ) from error
    if not isinstance(content, dict):
        raise CalibrationError(f"{path}: holds no 'key: value' lines; repair it or export it again")
    return content
