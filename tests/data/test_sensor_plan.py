"""Plan of fine-tuning on scans of a sensor: split, sizes, files that the commands take."""

import pytest
import yaml

from lidarsim import Simulator
from r3dpa.cli import main
from r3dpa.data import write_bin
from r3dpa.data.sensor_plan import SensorPlan, Split, split_of


@pytest.fixture(scope="module")
def scans(tmp_path_factory):
    folder = tmp_path_factory.mktemp("vlp16")
    for number in range(4):
        points = Simulator(sensor="vlp16").scan(40 * number).points
        write_bin(folder / f"{number}.bin", points)
    return folder


@pytest.mark.parametrize(
    ("num", "expected"),
    [
        (1, (1, 0, 5)),
        (2, (2, 0, 5)),
        (3, (1, 2, 2)),
        (4, (2, 2, 2)),
        (7, (5, 2, 4)),
        (30, (24, 6, 5)),
        (1000, (800, 200, 5)),
    ],
)
def test_every_fifth_scan_is_held_out_and_at_least_two_of_three(num, expected):
    assert split_of(num) == Split(*expected)


def test_in_place_of_too_few_scans_simulated_ones_are_held_out(scans, tmp_path):
    plan = SensorPlan.of("vlp16", str(scans / "0.bin"), 0.1)
    assert "1 to train on, too few to hold out: simulated scans take their place" in str(plan)
    assert "they compare with simulated scans" in plan.more
    data = plan.files(tmp_path)["data"]["data"]["init_args"]
    assert (data["scans"], data["val_every"]) == (str(tmp_path / "simulated"), 5)
    assert data["further_scans"] == str(scans / "0.bin")


def test_plan_of_a_sensor_of_sixteen_beams(scans, tmp_path, capsys):
    words = ["plan", "vlp16", "--scans", str(scans), "--out", str(tmp_path), "--minutes", "0.1"]
    main(["data", *words])
    shown = capsys.readouterr().out
    assert "image: 16 x 1024, 0.5 to 100 m, one row per beam\n" in shown
    assert "of the points of 4 scans within the range limits come back" in shown
    assert "2 to train on, 2 held out" in shown
    assert "2000 would take longer than the time allows" in shown
    simulated = yaml.safe_load((tmp_path / "simulate.yaml").read_text())
    assert simulated["sensor"] == "vlp16"
    vae = yaml.safe_load((tmp_path / "vae.yaml").read_text())
    assert vae["model"]["init_args"]["vae"]["init_args"]["stem"] == [1, 8]
    assert "GPU" in (tmp_path / "more.txt").read_text()

    # The commands of `make my-sensor` take the files.
    for stage, conf in (("vae", "vae_alignment"), ("flow", "flow_matching")):
        files = ["conf/trainer.yaml", "conf/r3dpa_s/trainer.yaml", str(tmp_path / "data.yaml")]
        files += [f"conf/r3dpa_s/{conf}.yaml", f"conf/r3dpa_s/demo_{stage}.yaml"]
        files += [str(tmp_path / f"{stage}.yaml")]
        with pytest.raises(SystemExit) as ended:
            main(["fit", *(w for f in files for w in ("--config", f)), "--print_config"])
        assert ended.value.code == 0


def test_columns_that_no_stem_can_fold_are_refused(scans):
    with pytest.raises(ValueError, match="columns must be a multiple of 128, got 1000"):
        SensorPlan.of("vlp16", str(scans), 1.0, 1000)


def test_scans_of_another_sensor_are_refused(scans):
    """Of 1808 shots of a beam, 1024 columns have room for 57 %, and beams share rows."""
    message = (
        rf"only \d\d% of the points of {scans} come back from range images of the sensor os0_32 "
        rf"\(32 beams, 1024 columns\), at least 60% .*`r3dpa data sensor {scans} --out mine.yaml`"
    )
    with pytest.raises(ValueError, match=message):
        SensorPlan.of("os0_32", str(scans), 1.0)
