"""overfly doctor: the machine, the installed parts, and an autopilot that is set well or badly."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from overfly.cli import main
from overfly.cli.doctor_command import PARTS
from overfly.navigation.mavlink import Autopilot
from overfly.navigation.mavlink.checks import SETTINGS, Verdict, check_settings

from .fake_autopilot import FakeAutopilot

GOOD = {
    Autopilot.ARDUPILOT: {
        "VISO_TYPE": 1, "AHRS_EKF_TYPE": 3, "EK3_ENABLE": 1, "EK3_SRC1_POSXY": 6, "EK3_SRC1_VELXY": 6,
        "EK3_SRC1_YAW": 6, "VISO_QUAL_MIN": 20, "VISO_POS_M_NSE": 0.1, "VISO_DELAY_MS": 50,
    },
    Autopilot.PX4: {
        "EKF2_EN": 1, "EKF2_EV_CTRL": 11, "EKF2_EV_NOISE_MD": 0, "EKF2_EV_QMIN": 20, "EKF2_EV_DELAY": 0.0,
        "EKF2_EVP_NOISE": 0.05,
    },
}  # fmt: skip


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("overfly.navigation.mavlink.checks.LISTEN_S", 1.0)


def verdicts(text: str) -> dict[str, str]:
    return {finding["what"]: finding["verdict"] for finding in json.loads(text)["findings"]}


@pytest.mark.parametrize("kind", Autopilot)
def test_an_autopilot_that_is_set_as_the_docs_say(
    kind: Autopilot, capsys: pytest.CaptureFixture[str]
) -> None:
    with FakeAutopilot(kind, GOOD[kind]) as autopilot:
        assert main(["doctor", "--mavlink", autopilot.url, "--json"]) == 0
    found = verdicts(capsys.readouterr().out)
    assert all(found[name] == "good" for name in GOOD[kind])
    assert found["clock"] == found["ATTITUDE"] == found["DISTANCE_SENSOR"] == "good"


def test_an_autopilot_that_would_pass_everything_over(capsys: pytest.CaptureFixture[str]) -> None:
    badly = GOOD[Autopilot.ARDUPILOT] | {"VISO_TYPE": 0, "VISO_QUAL_MIN": 0}
    del badly["EK3_SRC1_POSXY"]
    with FakeAutopilot(Autopilot.ARDUPILOT, badly, attitude_hz=4.0) as autopilot:
        assert main(["doctor", "--mavlink", autopilot.url]) == 1
    text = capsys.readouterr().out
    lines = {line.split()[1]: line for line in text.splitlines() if line.split()[0] in list(Verdict)}
    assert lines["VISO_TYPE"].startswith("wrong") and "set 1" in lines["VISO_TYPE"]
    assert lines["EK3_SRC1_POSXY"].startswith("wrong") and "no answer" in lines["EK3_SRC1_POSXY"]
    assert lines["VISO_QUAL_MIN"].startswith("note")
    assert lines["ATTITUDE"].startswith("wrong")
    assert text.splitlines()[-1] == "3 to put right"


@pytest.mark.parametrize("kind", Autopilot)
def test_every_setting_can_be_wrong_and_says_what_to_do(kind: Autopilot) -> None:
    for setting in SETTINGS[kind]:
        (good,) = check_settings([setting], lambda name: float(GOOD[kind][name]))
        (bad,) = check_settings([setting], lambda _name: 77_000.0)
        assert (good.verdict, good.advice) == (Verdict.GOOD, "")
        assert setting.name == "EKF2_EV_CTRL" or bad.verdict is setting.otherwise
        (none,) = check_settings([setting], lambda _name: None)
        assert none.verdict is setting.otherwise and none.advice


def test_the_parameters_are_those_of_the_docs() -> None:
    text = (Path(__file__).resolve().parents[2] / "docs" / "autopilots.md").read_text(encoding="utf-8")
    for kind in Autopilot:
        for setting in SETTINGS[kind]:
            assert f"`{setting.name}`" in text


def test_the_machine_alone(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["doctor", "--json"]) == 0
    found = verdicts(capsys.readouterr().out)
    assert set(PARTS) <= set(found)
    assert {"Python", "processors", "memory", "free disk", "compiled cache"} <= set(found)


def test_nobody_answers(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("overfly.navigation.mavlink.link.ANSWER_S", 0.2)
    assert main(["doctor", "--mavlink", "udpout:127.0.0.1:9"]) == 1
    assert "no heartbeat" in capsys.readouterr().err
