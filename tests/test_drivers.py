"""Drivers are found by name, built in or installed, and whoever uses a rig need not know which."""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import sys
import tomllib
from collections.abc import Callable, Iterator
from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules
from typing import Any

import numpy as np
import pytest

import third_party
from fake_bench import FakeBench
from running import wait_for
from stiffopt.errors import DeviceError, FileError, InputError
from stiffopt.files import file_text, save_file
from stiffopt.lab.virtual import VirtualLab
from stiffopt.model.robot_files import load_description
from stiffopt.rig import drivers
from stiffopt.rig.config import RigDescription, load_rig, load_rig_description
from stiffopt.rig.device import DeviceSettings
from stiffopt.rig.registry import KINDS, driver_class, driver_names, load
from stiffopt.safety.rigs import guarded_rig, open_rig
from stiffopt.safety.vent import vent_rig

ROOT = Path(__file__).parent.parent
ROBOT = load_description("stiff-flop-1")
BUILT_IN = {
    "supply": ("simulated", "modbus", "nidaq", "open-regulator"),
    "tracker": ("simulated", "aurora", "openigtlink"),
    "probe": ("simulated", "probe"),
}
IN_FULL = "line_driver:LineSettings"


# Drivers of stiffopt -----------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
def test_every_driver_is_found_by_its_name(kind: str) -> None:
    assert driver_names(kind)[: len(BUILT_IN[kind])] == BUILT_IN[kind]
    for name in BUILT_IN[kind]:
        model = driver_class(kind, name)
        assert issubclass(model, KINDS[kind])
        assert model.model_fields["driver"].default == name
        assert model.simulated == (name == "simulated")


def test_every_settings_class_of_the_drivers_can_be_found() -> None:
    found = {driver_class(kind, name) for kind, names in BUILT_IN.items() for name in names}
    for module in iter_modules(drivers.__path__):
        if module.name == "ndi_reader":  # a program of its own
            continue
        content = vars(import_module(f"{drivers.__name__}.{module.name}")).values()
        for made in content:
            if isinstance(made, type) and issubclass(made, DeviceSettings):
                assert made in {*found, *KINDS.values()} or made.__name__ == "StreamedSettings"


def test_every_driver_of_a_device_has_an_extra_and_a_peer() -> None:
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    for kind, names in BUILT_IN.items():
        for name in names[1:]:
            model = driver_class(kind, name)
            assert model.extra in extras["optional-dependencies"]
            assert model.extra in extras["optional-dependencies"]["rig"][0]
            assert callable(load(model.peer))


def test_reading_a_rig_file_imports_no_driver_but_its_own() -> None:
    script = (
        "import sys\n"
        "from stiffopt.rig.config import load_rig_description\n"
        "assert not [m for m in sys.modules if m.startswith(('stiffopt.rig.drivers.', "
        "'stiffopt.plant', 'stiffopt.lab'))]\n"
        f"load_rig_description({str(ROOT / 'rig' / 'openigtlink.yaml')!r})\n"
        "assert 'stiffopt.rig.drivers.openigtlink' in sys.modules\n"
        "assert 'stiffopt.rig.drivers.aurora' not in sys.modules\n"
        "assert not {'numba', 'pymodbus', 'nidaqmx', 'pyigtl'} & set(sys.modules)\n"
    )
    subprocess.run([sys.executable, "-c", script], check=True, timeout=60)


# A driver of an installed package ----------------------------------------------------------------


@pytest.fixture(scope="module", autouse=True)
def _installed() -> None:
    third_party.install()


@pytest.fixture
def rig_file(tmp_path: Path) -> Callable[..., Path]:
    def write(driver: str, port: int = 4000, **more: Any) -> Path:
        settings = {"driver": driver, "port": port, "channels": [{}, {"max": 1e5}, {}], **more}
        description = RigDescription(robot="stiff-flop-1", supply=settings)
        save_file(tmp_path / "rig.yaml", "rig", description)
        return tmp_path / "rig.yaml"

    return write


@pytest.fixture
def regulators() -> Iterator[tuple[FakeBench, int]]:
    """A device that speaks the protocol, and its port."""
    bench = FakeBench()
    model = driver_class("supply", "line")
    peer = load(model.peer)(model(channels=[{}] * 3), bench)
    yield bench, peer.start().port
    peer.close()


def test_an_installed_driver_is_known_by_the_name_that_it_announces() -> None:
    assert driver_names("supply") == (*BUILT_IN["supply"], "line")
    assert driver_class("supply", "line") is driver_class("supply", IN_FULL)


@pytest.mark.parametrize("driver", ["line", IN_FULL])
def test_its_settings_survive_files_and_processes(driver: str, rig_file: Any) -> None:
    path = rig_file(driver)
    description = load_rig_description(path)
    assert description.supply.driver == driver
    assert description.supply.channels[1].max == 1e5
    text = file_text("rig", description)
    assert f"driver: {driver}" in text.replace("'", "")
    assert pickle.loads(pickle.dumps(description)) == description
    script = f"import pickle, sys; print(pickle.load(sys.stdin.buffer).supply.driver == {driver!r})"
    done = subprocess.run(
        [sys.executable, "-P", "-c", script], input=pickle.dumps(description), stdout=-1, check=True
    )
    assert done.stdout.strip() == b"True"


def test_settings_made_in_code_name_their_class() -> None:
    model = driver_class("supply", "line")
    assert model(channels=[{}]).driver == IN_FULL
    description = RigDescription(robot="stiff-flop-1", supply=model(channels=[{}] * 3))
    assert f"driver: {IN_FULL}" in file_text("rig", description).replace("'", "")


@pytest.mark.parametrize("driver", ["line", IN_FULL])
def test_a_program_commands_through_the_guard(
    driver: str, rig_file: Any, regulators: tuple[FakeBench, int]
) -> None:
    bench, port = regulators
    with open_rig(rig_file(driver, port)) as rig:
        assert rig.supply.limits.high.tolist() == [1.5e5, 1e5, 1.5e5]
        rig.supply.arm()

        def commanded() -> bool:
            rig.command([5e4, 2e4, 0.0], valid_for=1.0)
            return bool(np.allclose(bench.pressures, [5e4, 2e4, 0.0], atol=1.0))

        wait_for(commanded)
        assert np.allclose(rig.supply.read().pressures, bench.pressures, atol=1.0)
        assert vent_rig(rig_file(driver, port)).startswith("vented by its guard")
        wait_for(lambda: not bench.pressures.any())
    assert not bench.pressures.any()


def test_when_the_guard_is_killed_the_supply_is_vented_directly(
    rig_file: Any, regulators: tuple[FakeBench, int]
) -> None:
    bench, port = regulators
    rig, link = guarded_rig(*load_rig(rig_file("line", port)))
    with rig:
        rig.supply.arm()
        rig.command([5e4, 0.0, 0.0], valid_for=9.0)
        wait_for(lambda: bench.pressures[0] > 4e4)
        assert link.pid is not None
        os.kill(link.pid, signal.SIGKILL)
        wait_for(lambda: not bench.pressures.any(), 0.4)  # sooner than by the device's watchdog
        with pytest.raises(DeviceError, match="the guard process has ended"):
            rig.command([5e4, 0.0, 0.0], valid_for=9.0)
    assert not bench.pressures.any()


def test_a_rig_without_a_guard_is_vented_directly(
    rig_file: Any, regulators: tuple[FakeBench, int]
) -> None:
    bench, port = regulators
    bench.command(0, 5e4)
    assert vent_rig(rig_file("line", port)).startswith("vented directly")
    assert not bench.pressures.any()


def test_the_virtual_lab_plays_its_device(tmp_path: Path) -> None:
    description = load_rig_description(ROOT / "rig" / "sim.yaml")
    description = description.model_copy(update={"tracker": None, "probe": None})
    with VirtualLab(description, ROBOT, supply="line") as lab:
        save_file(tmp_path / "lab.yaml", "rig", lab.start())
        with open_rig(tmp_path / "lab.yaml") as rig:
            rig.supply.arm()

            def pressed() -> bool:
                rig.command([5e4, 0.0, 0.0], valid_for=1.0)
                return bool(rig.supply.read().pressures[0] > 4.5e4)

            wait_for(pressed, 10.0)
        wait_for(lambda: (lab.world.pressures < 1e3).all())


def test_a_driver_without_a_peer_is_none_for_the_lab(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(driver_class("supply", "line"), "peer", "")
    description = load_rig_description(ROOT / "rig" / "sim.yaml")
    with pytest.raises(InputError, match="it has no peer"):
        VirtualLab(description, ROBOT, supply="line")


# Mistakes and attacks ----------------------------------------------------------------------------


RIG = "format: stiffopt-rig/1\nrobot: stiff-flop-1\nsupply:\n  driver: {driver}\n  {more}\n"


@pytest.mark.parametrize(
    ("more", "key", "line", "said"),
    [
        ("channels: [{}, {}]", "supply.channels", 5, "has 2 channels; the robot"),
        ("chanels: [{}, {}, {}]", "supply", 3, "line 5: supply.chanels: .*mean 'channels'"),
        ("channels: [{}, {maxx: 1 bar}, {}]", "supply.channels", 5, "did you mean 'max'"),
        ("channels: [{}, {max: 1}, {}]", "supply.channels[1].max", 5, "no unit"),
        ("channels: [{}, {max: 9 bar}, {}]", "supply.channels[1].max", 5, "above the robot's"),
        ("host: here", "supply", 3, "the key 'channels' is missing"),
    ],
)
@pytest.mark.parametrize("driver", ["line", IN_FULL])
def test_mistakes_in_its_keys_are_told_as_those_of_any_driver(
    driver: str, more: str, key: str, line: int, said: str, tmp_path: Path
) -> None:
    path = tmp_path / "rig.yaml"
    path.write_text(RIG.format(driver=driver, more=more))
    with pytest.raises(FileError, match=said) as caught:
        load_rig_description(path)
    assert caught.value.key is not None
    assert caught.value.key.startswith(key)
    assert caught.value.line == line


@pytest.mark.parametrize(
    ("driver", "said"),
    [
        ("lime", "did you mean 'line'.*expected simulated, modbus, nidaq, open-regulator or line"),
        ("nowhere_at_all:Settings", "is not installed: there is no module 'nowhere_at_all'"),
        ("line_driver.deeper:Settings", "is not installed"),
        ("line_driver:Nobody", "has no class 'Nobody'"),
        ("line_driver:LineSupply", "no subclass of SupplySettings"),
        ("line_driver:LineChannel", "no subclass of SupplySettings"),
        ("line_driver:math", "no subclass of SupplySettings"),
        ("stiffopt.plant.settings:SimulatedSupplySettings", "expected simulated, modbus"),
        ("os:system", "belongs to no installed package"),
        ("../evil:Settings", "there is no module"),
        (":", "there is no module"),
        ("[1]", "expected the name of a driver"),
    ],
)
def test_what_is_no_driver_is_refused(driver: str, said: str, tmp_path: Path) -> None:
    path = tmp_path / "rig.yaml"
    given = driver if driver.startswith("[") else f"'{driver}'"
    path.write_text(RIG.format(driver=given, more="channels: [{}, {}, {}]"))
    with pytest.raises(FileError, match=said) as caught:
        load_rig_description(path)
    assert (caught.value.key, caught.value.line) == ("supply.driver", 4)


EVIL = "import pathlib; pathlib.Path(__file__).with_name('executed').touch()\nSettings = 1\n"


@pytest.mark.parametrize("on_path", ["", ".", "{folder}"])
@pytest.mark.parametrize("disguised", [False, True])
def test_nothing_in_the_working_directory_is_ever_imported(
    on_path: str, disguised: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "evil_driver.py").write_text(EVIL)
    driver = "evil_driver:Settings"
    if disguised:  # as an installed package that announces it
        announce(tmp_path, "evil", "evil_driver", "supply", "evil")
        driver = "evil"
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(on_path.format(folder=tmp_path))
    path = tmp_path / "rig.yaml"
    path.write_text(RIG.format(driver=driver, more="channels: []"))
    with pytest.raises(FileError, match="driver"):
        load_rig_description(path)
    assert not (tmp_path / "executed").exists()


def test_nor_is_a_module_that_no_package_has_installed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "evil_driver.py").write_text(EVIL)
    monkeypatch.syspath_prepend(tmp_path)  # as by PYTHONPATH
    with pytest.raises(InputError, match="belongs to no installed package"):
        driver_class("supply", "evil_driver:Settings")
    announce(tmp_path, "evil", "evil_driver", "supply", "evil", listed=False)
    with pytest.raises(InputError, match="belongs to no installed package"):
        driver_class("supply", "evil")
    assert not (tmp_path / "executed").exists()


def test_nor_is_one_that_stands_in_front_of_an_installed_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "line_driver.py").write_text(EVIL)
    monkeypatch.delitem(sys.modules, "line_driver", raising=False)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend("")
    for driver in ("line", IN_FULL):
        with pytest.raises(InputError, match="belongs to no installed package"):
            driver_class("supply", driver)
    assert not (tmp_path / "executed").exists()


def announce(
    folder: Path, package: str, module: str, kind: str, name: str, *, listed: bool = True
) -> None:
    """Write what `pip` writes about an installed package with one driver."""
    info = folder / f"{package}-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(f"[stiffopt.{kind}]\n{name} = {module}:Settings\n")
    (info / "RECORD").write_text(f"{module}.py,,\n" if listed else "")


def test_a_package_that_fails_to_import_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "bad_driver.py").write_text("1 / 0\n")
    announce(tmp_path, "bad", "bad_driver", "tracker", "bad")
    monkeypatch.syspath_prepend(tmp_path)
    assert "bad" in driver_names("tracker")
    assert "bad" not in driver_names("supply")
    with pytest.raises(InputError, match="cannot be imported: ZeroDivisionError"):
        driver_class("tracker", "bad")


def test_two_packages_with_one_name_must_be_told_apart(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    announce(tmp_path, "other", "other_driver", "supply", "line")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(InputError, match=r"several installed .* line-driver, other; name one as"):
        driver_class("supply", "line")
    assert driver_class("supply", IN_FULL)


def test_no_package_can_take_the_name_of_a_driver_of_stiffopt(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    announce(tmp_path, "other", "other_driver", "supply", "modbus")
    monkeypatch.syspath_prepend(tmp_path)
    assert driver_class("supply", "modbus").__module__ == "stiffopt.rig.drivers.modbus"
    assert driver_names("supply").count("modbus") == 1


def test_an_editable_install_counts_as_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    site, source = tmp_path / "site", tmp_path / "source"
    site.mkdir()
    source.mkdir()
    text = (third_party.EXAMPLE / "line_driver.py").read_text()
    (source / "edited_driver.py").write_text(text.replace("class LineSettings", "class Settings"))
    announce(site, "edited", "edited", "supply", "edited", listed=False)
    (site / "edited-1.0.dist-info" / "RECORD").write_text("edited.pth,,\n")
    (site / "edited.pth").write_text(f"{source}\n")
    for folder in (site, source):
        monkeypatch.syspath_prepend(folder)
    assert driver_class("supply", "edited_driver:Settings").__name__ == "Settings"
