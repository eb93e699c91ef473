"""Names in files that would leave a folder are refused wherever such a file is read."""

from __future__ import annotations

import io
import json
import pickle
import zipfile
from dataclasses import replace

import numpy as np
import pytest
from safetensors import safe_open
from safetensors.torch import save_file

from lidarsim import expected_scans
from lidarsim.scan_files import read_npz
from r3dpa.data import read_samples
from r3dpa.geometry import LidarSensor
from r3dpa.io import refuse_name
from r3dpa.metrics.official_statistics import OfficialStatistics
from r3dpa.metrics.reference import ReferenceStatistics
from r3dpa.metrics.scene import PROTOCOLS

BAD = ["../../x", "/etc/x", "a/../../x", "a/./x", "a//x", "..", ".", "", "C:x", "c:\\x", "a\\..\\x"]
BAD += ["a\0b", "a\nb", "x" * 2000]
POINTS = np.full((3, 4), 5.0, np.float32)


def test_bad_and_good_names():
    for name in (*BAD, 3, None, ["a"]):
        assert refuse_name(name), name
    for name in ("a", "a/b", "2013_05_28_drive_0003_sync/0000000000", "..a", "ü 1"):
        assert refuse_name(name) is None


def test_members_of_archives(tmp_path):
    array = io.BytesIO()
    np.save(array, POINTS)
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.writestr("../../x.npy", array.getvalue())
    with pytest.raises(ValueError, match=r"a\.npz, member .*\(its name"):
        read_npz(tmp_path / "a.npz")
    with pytest.raises(ValueError, match=r"a\.npz, member .*\(its name"):
        list(read_samples(tmp_path / "a.npz", LidarSensor(4, 16)))


def test_names_in_a_reference(tmp_path):
    path = tmp_path / "a.safetensors"
    protocol = replace(PROTOCOLS["default"], sensor=LidarSensor(4, 16))
    ReferenceStatistics(protocol, {}, ["a/0", "b/0"], {}).save(path)
    with safe_open(path, framework="pt") as file:
        tensors, about = {key: file.get_tensor(key) for key in file.keys()}, file.metadata()  # noqa: SIM118
    card = json.loads(about["r3dpa_reference"])
    card["names"][0] = "../../x"
    save_file(tensors, path, {"r3dpa_reference": json.dumps(card)})
    with pytest.raises(ValueError, match=r"a\.safetensors holds no .*name of a scan"):
        ReferenceStatistics.load(path)


@pytest.mark.parametrize("drive", ["../../x", "/etc", "0003/../..", ""])
def test_drives_in_a_manifest(drive, tmp_path):
    (tmp_path / "simulation.json").write_text(json.dumps({"scans": 3, "drives": [drive]}))
    with pytest.raises(ValueError, match=r"simulation\.json does not say"):
        expected_scans(tmp_path)


@pytest.mark.parametrize("count", [2**40, 2**62])
def test_few_bytes_that_ask_for_much_memory(tmp_path, count):
    head = f"{{'descr': '<f4', 'fortran_order': False, 'shape': ({count}, 4)}}"
    data = b"\x93NUMPY\x01\x00\x76\x00" + head.encode().ljust(117) + b"\n" + bytes(64)
    (tmp_path / "a.npy").write_bytes(data)
    with pytest.raises(ValueError, match=r"a\.npy: cannot be read as an array"):
        list(read_samples(tmp_path / "a.npy", LidarSensor(4, 16)))
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.writestr("a.npy", data)
    with pytest.raises(ValueError, match=r"a\.npz, member 'a\.npy': is damaged"):
        read_npz(tmp_path / "a.npz")


@pytest.mark.parametrize(("num_members", "claim"), [(1, 2**31), (4, 2**27)])
def test_a_directory_that_claims_more_than_the_archive_holds(tmp_path, num_members, claim):
    """One member alone, or all members together."""
    np.savez(tmp_path / "a.npz", *[POINTS] * num_members)
    data = bytearray((tmp_path / "a.npz").read_bytes())
    size = 0
    for _ in range(num_members):
        size = data.index(b"PK\x01\x02", size) + 24  # of the unpacked size
        data[size : size + 4] = claim.to_bytes(4, "little")
    (tmp_path / "a.npz").write_bytes(data)
    with pytest.raises(ValueError, match=r"a\.npz: .*larger than the file"):
        read_npz(tmp_path / "a.npz")


@pytest.mark.parametrize(
    ("pickled", "reason"),
    [
        (b"\x80\x04}r\xff\xff\xff\x7f.", "no attribute 'item'"),
        (b"\x80\x05\x8e" + (2**40).to_bytes(8, "little") + b"abc.", "EOFError"),
        (b"cnumpy\nndarray\n(I1099511627776\ntR.", "not callable"),
        (
            pickle.dumps(np.array([None] * 77), 3).replace(b"KM\x85", b"J\xff\xff\xff\x7f\x85"),
            r"array of shape \(2147483647,\) is cut short",
        ),
    ],
)
def test_pickles_that_ask_for_much_memory(pickled, reason, tmp_path):
    path = tmp_path / "statistics.npy"
    np.save(path, np.array(None), allow_pickle=True)
    path.write_bytes(path.read_bytes()[:128] + pickled)
    with pytest.raises(ValueError, match=rf"statistics\.npy: is no official .*{reason}"):
        OfficialStatistics.load(path)
