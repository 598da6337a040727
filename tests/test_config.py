"""Settings: nothing unknown, nothing out of range, the same from a file as from the command line."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml
from pydantic import BaseModel, ValidationError

from overfly.config import AttitudeUse, Config, load_config
from overfly.errors import ConfigError


def test_defaults_survive_the_way_through_a_file(tmp_path: Path) -> None:
    path = tmp_path / "config.yaml"
    path.write_text(Config().to_yaml())
    assert load_config(path) == Config()
    assert load_config() == Config()


def test_every_section_refuses_unknown_keys() -> None:
    sections = {name: field.annotation for name, field in Config.model_fields.items()}
    assert len(sections) >= 8
    for name, section in sections.items():
        assert isinstance(section, type) and issubclass(section, BaseModel)
        with pytest.raises(ConfigError, match=rf"{name}\.no_such_thing"):
            load_config(None, [f"{name}.no_such_thing=1"])
        assert section.model_config["extra"] == "forbid"
        assert section.model_config["frozen"] is True


def test_every_setting_with_a_number_has_a_range_and_words() -> None:
    """A number without a bound is a number that somebody will set to -1."""
    for name, field in Config.model_fields.items():
        section = field.annotation
        assert isinstance(section, type) and issubclass(section, BaseModel)
        for key, setting in section.model_fields.items():
            if setting.annotation in (int, float):
                assert setting.metadata, f"{name}.{key} has no range"


@pytest.mark.parametrize(
    "text",
    [
        "features: {count: -3}",
        "features: {count: many}",
        "registration: {blend: 1.5}",
        "attitude: {use: sometimes}",
        "nodes: {displacement: 1.0}",
        "nodes: {height_ratio: 1.0}",
        "height: {given_m: 0}",
        "window: {nodes: 1000}",
        "colour: {red: 1}",
        "features: 7",
        "- just\n- a list",
        "features: {count: [1, 2",
    ],
)
def test_what_does_not_fit_is_one_clear_line(tmp_path: Path, text: str) -> None:
    path = tmp_path / "config.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError) as caught:
        load_config(path)
    assert "\n" not in str(caught.value)
    assert caught.value.exit_code == 2


def test_a_missing_or_binary_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="absent"):
        load_config(tmp_path / "absent.yaml")
    (tmp_path / "picture.yaml").write_bytes(b"\x89PNG\xff\xfe\x00")
    with pytest.raises(ConfigError, match="picture"):
        load_config(tmp_path / "picture.yaml")


def test_an_empty_file_changes_nothing(tmp_path: Path) -> None:
    (tmp_path / "empty.yaml").write_text("# only a comment\n")
    assert load_config(tmp_path / "empty.yaml") == Config()


def test_assignments_override_the_file_and_have_types(tmp_path: Path) -> None:
    path = tmp_path / "config.yaml"
    path.write_text("features: {count: 100, extractor: sift}\n")
    config = load_config(
        path, ["features.count=200", "attitude.use=fixed", "tracking.enabled=false", "height.given_m=3"]
    )
    assert config.features.count == 200
    assert config.features.extractor == "sift"
    assert config.attitude.use is AttitudeUse.FIXED
    assert config.tracking.enabled is False
    assert config.height.given_m == 3.0


def test_the_last_assignment_wins() -> None:
    assert load_config(None, ["features.count=100", "features.count=120"]).features.count == 120


@pytest.mark.parametrize(
    "assignment",
    ["features.count", "features=3", "=3", "count=3", "features.=3", ".count=3", "features.count=[1"],
)
def test_assignments_that_mean_nothing_are_refused(assignment: str) -> None:
    with pytest.raises(ConfigError) as caught:
        load_config(None, [assignment])
    assert "\n" not in str(caught.value)


def test_an_assignment_into_a_section_that_is_none_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "config.yaml"
    path.write_text("features: 7\n")
    with pytest.raises(ConfigError):
        load_config(path, ["features.count=30"])


def test_an_empty_section_is_the_default_one(tmp_path: Path) -> None:
    path = tmp_path / "config.yaml"
    path.write_text("features:\nnodes: {previous: 2}\n")
    with pytest.raises(ConfigError, match="features"):
        load_config(path)


def test_hash_names_the_settings() -> None:
    assert Config().hash() == Config().hash()
    assert len(Config().hash()) == 12
    assert load_config(None, ["features.count=401"]).hash() != Config().hash()
    assert load_config(None, [f"features.count={Config().features.count}"]).hash() == Config().hash()


def test_settings_cannot_be_changed_afterwards() -> None:
    with pytest.raises(ValidationError):
        Config().features.count = 3  # type: ignore[misc]


def test_dumped_settings_are_plain_yaml() -> None:
    tree = yaml.safe_load(Config().to_yaml())
    assert tree["attitude"]["use"] == "prior"
    assert list(tree) == list(Config.model_fields)
