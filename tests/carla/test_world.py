"""What a person at the terminal is told when CARLA cannot be reached or is asked for what it cannot do."""

from __future__ import annotations

import socket
import sys
import threading

import pytest

from bench.errors import UserError
from bench.scenarios.grid import Cell
from envs.camera.carla.world import CarlaWorld

CELL = Cell(lanes=3, density=1.0)
WITHOUT = "needs the carla package: pip install cavbench[carla]"


@pytest.mark.parametrize(
    "wrong",
    [
        {"host": ""},
        {"port": 0},
        {"port": 65535},
        {"timeout_s": 0.0},
        {"timeout_s": float("inf")},
        {"sign": ""},
        {"face_region": (0.0, 0.0, 0.0, 1.0)},
        {"face_region": (0.0, 0.0, 1.0, 1.5)},
        {"sun_azimuth_zero_deg": float("nan")},
        {"time_step_s": 0.2},
        {"settle_ticks": -1},
    ],
    ids=str,
)
def test_a_field_out_of_range_is_refused_by_name(wrong: dict[str, object]) -> None:
    with pytest.raises(ValueError, match=next(iter(wrong))):
        CarlaWorld(**wrong)  # type: ignore[arg-type]


def test_without_the_package_one_line_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "carla", None)
    with pytest.raises(UserError, match=r"pip install cavbench\[carla\]$") as caught:
        CarlaWorld().scenes(CELL, "sun-beside")
    assert "\n" not in str(caught.value)


def test_an_unknown_location_is_refused_before_anything_is_connected() -> None:
    with pytest.raises(UserError, match="sun-beside"):
        CarlaWorld().scenes(CELL, "sun-besides")


def free_port() -> int:
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        return min(int(found.getsockname()[1]), 65534)


def test_without_a_server_one_line_says_where_it_was_looked_for() -> None:
    pytest.importorskip("carla", reason=WITHOUT)
    port = free_port()
    with pytest.raises(UserError, match=f"127.0.0.1:{port} failed: time-out") as caught:
        CarlaWorld(port=port, timeout_s=0.5).scenes(CELL, "sun-beside")
    assert "\n" not in str(caught.value)


def test_a_host_that_does_not_exist_is_one_line_too() -> None:
    pytest.importorskip("carla", reason=WITHOUT)
    with pytest.raises(UserError, match=r"no-such-host\.invalid:2000 failed: "):
        CarlaWorld(host="no-such-host.invalid", timeout_s=0.5).connect()


def answers_its_version(listening: socket.socket, version: bytes) -> None:
    """Answers one call as a CARLA server answers `version`: [1, call, no error, [[1, version]]] in MessagePack."""
    connection, _ = listening.accept()
    with connection:
        call = connection.recv(4096)[2:3]
        connection.sendall(b"\x94\x01" + call + b"\xc0\x91\x92\x01" + bytes([0xA0 + len(version)]) + version)
        connection.recv(1)


def test_a_server_of_another_version_is_refused() -> None:
    pytest.importorskip("carla", reason=WITHOUT)
    with socket.create_server(("127.0.0.1", 0)) as listening:
        port = listening.getsockname()[1]
        thread = threading.Thread(target=answers_its_version, args=(listening, b"0.9.15"), daemon=True)
        thread.start()
        with pytest.raises(UserError, match=r"is 0\.9\.15, the client 0\.9\.16: start a 0\.9\.16 server"):
            CarlaWorld(port=port, timeout_s=5.0).connect()
