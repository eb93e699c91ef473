"""Plans of ablations: what rows share, what a name depends on, and what is refused."""

from collections import Counter
from pathlib import Path

import pytest
import yaml
from resolved_fits import resolved

from r3dpa.ablation import budget_of, make_plan
from r3dpa.ablation import plan as plan_module
from r3dpa.ablation.runs import plan_jobs
from r3dpa.cli.bench import resolve_config
from r3dpa.cli.features import features_parser, with_data_class

TABLES = Path(__file__).resolve().parents[2] / "conf" / "ablation"
SEEDS = ("seed_everything", "model.init_args.seed", "data.init_args.seed", "scorer.seed")


def words_alone(words):
    """Stands for a configuration where only words matter: parsing takes a second per training."""
    return {"words": list(words)}


def plan_of(scale, seeds=(0,), tables=TABLES, resolve=resolved, **more):
    scale = TABLES / "scale" / f"{scale}.yaml" if isinstance(scale, str) else scale
    return make_plan(tables, scale, seeds, Path("out"), resolve, **more)


@pytest.fixture
def shipped(tmp_path):
    """``shipped(table_1=["r2dm"])``: folder of shipped tables with these rows alone."""

    def write(**rows):
        folder = tmp_path / "tables"
        folder.mkdir()
        for name, keys in rows.items():
            table = yaml.safe_load((TABLES / f"{name}.yaml").read_text())
            given = {"caption": "", "rows": {key: table["rows"][key] for key in keys}}
            (folder / f"{name}.yaml").write_text(yaml.safe_dump(given, sort_keys=False))
        return folder

    return write


def rows_of(plan):
    return {(table.name, row.key): row for table in plan.tables for row in table.rows}


def names_of(stages):
    return [stage.name for stage in stages]


def test_trainings_that_rows_share_are_planned_once():
    """Table II ends as table III begins; every stage comes after those that it starts from."""
    plan = plan_of("demo", resolve=words_alone)
    rows = rows_of(plan)
    last, first = rows["table_2", "aligned"], rows["table_3", "none"]
    assert names_of(last.stages[0]) == names_of(first.stages[0])
    names = names_of(plan.stages)
    assert len(set(names)) == len(names) < sum(map(len, plan.chains))
    for place, stage in enumerate(plan.stages):
        assert set(stage.before) <= set(names[:place])
    assert all(len(row.published) == 6 for row in rows.values())


def test_trainings_of_table_1_are_those_of_the_paper_and_the_others_its_ablations(shipped):
    tables = {"table_1": ["lidm_ape", "r3dpa"], "table_3": ["joint"], "table_4": ["unet", "sit"]}
    plan = plan_of("paper", tables=shipped(**tables))
    rows = rows_of(plan)
    steps = {
        key: {stage.words[0]: stage.config["trainer"]["max_steps"] for stage in row.stages[0]}
        for key, row in rows.items()
    }
    ours = {"rgb_pretraining": 1_000_000, "vae_alignment": 800_000, "joint": 1_000_000}
    assert steps["table_1", "r3dpa"] == ours
    assert steps["table_3", "joint"] == ours | {"vae_alignment": 400_000, "joint": 400_000}
    assert steps["table_1", "lidm_ape"] == {"lidm_first_stage": 40_000, "lidm": 200_000}
    assert "1 vae_alignment of 800000 steps" in budget_of(plan)
    sit, unet = (rows["table_4", key].stages[0][-1] for key in ("sit", "unet"))
    for stage, network in ((sit, "SiT"), (unet, "UNet")):
        assert stage.config["model"]["init_args"]["sit"]["class_path"] == f"r3dpa.nn.{network}"


def test_a_second_seed_repeats_all_but_the_prior():
    one, two = (plan_of("demo", seeds, resolve=words_alone) for seeds in ((0,), (0, 1)))
    prior = [stage for stage in one.stages if not stage.on_scans]
    assert len(two.stages) == 2 * len(one.stages) - len(prior)
    assert set(names_of(one.stages)) < set(names_of(two.stages))
    for seed in (0, 1):
        vae, joint = rows_of(two)["table_3", "joint"].stages[seed][-2:]
        assert joint.words[-8::2] == [f"--{key}" for key in SEEDS]
        assert joint.words[-7::2] == [str(seed)] * 4
        assert str(vae.checkpoint) in joint.words


def test_the_name_depends_on_given_weights_which_replace_the_prior(tmp_path):
    names = []
    for content in ("one", "other"):
        weights = tmp_path / f"{content}.pt"
        weights.write_text(content)
        plan = plan_of("demo", (0,), TABLES / "table_2", words_alone, rgb_weights=weights)
        rows = rows_of(plan)
        assert str(weights) in rows["table_2", "rgb"].stages[0][-1].words
        names.append({key: set(names_of(row.stages[0])) for (_, key), row in rows.items()})
    assert names[0]["scratch"] == names[1]["scratch"]
    assert not names[0]["aligned"] & names[1]["aligned"]


def test_the_name_depends_on_the_training_not_on_the_test_or_the_folder(tmp_path, shipped):
    scale = yaml.safe_load((TABLES / "scale" / "demo.yaml").read_text())
    tables = shipped(table_4=["sit"])
    usual = names_of(plan_of("demo", tables=tables).stages)
    for section, key, out in (("scorer", "num_scenes", "a"), ("trainer", "max_steps", "b/c")):
        scale["config"][section][key] += 1
        (tmp_path / "demo.yaml").write_text(yaml.safe_dump(scale))
        file, out = tmp_path / "demo.yaml", tmp_path / out
        plan = make_plan(tables, file, (0,), out, resolve_config)
        assert (names_of(plan.stages) == usual) == (section == "scorer")


def test_an_unknown_released_row_is_refused_before_anything_is_planned():
    def resolve(words):
        pytest.fail(f"{words} was planned")

    scale = TABLES / "scale" / "demo.yaml"
    with pytest.raises(
        ValueError, match=r"--released\.nope: unknown row; choose from .*ultralidar"
    ):
        make_plan(TABLES, scale, (0,), Path("out"), resolve, released={"nope": Path("x")})


def test_released_files_stand_for_trainings(shipped, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # jobs write their configuration into the folder of the plan
    weights, samples = tmp_path / "r2dm.pth", tmp_path / "samples"
    weights.write_bytes(b"weights")
    samples.mkdir()
    released = {"r2dm": weights, "ultralidar": samples}
    tables = shipped(table_1=["ultralidar", "r2dm", "r3dpa"])
    plan = plan_of("demo", tables=tables, released=released)
    rows = rows_of(plan)
    assert next(key for _, key in rows) == "ultralidar"
    assert not any(stage.words[0] == "r2dm" for stage in plan.stages)
    jobs = {job.name: job for job in plan_jobs(plan)}
    (stage,) = rows["table_1", "r2dm"].stages[0]
    sampled, test = jobs[stage.name], jobs[f"test of {stage.name}"]
    assert sampled.words[:3] == ["sample", "--ckpt", str(weights)]
    assert "--steps" not in sampled.words  # a baseline has a published sampler
    assert test.words[:3] == ["evaluate", "--samples", sampled.words[4]]
    assert (test.needs, test.makes) == ((stage.name, "reference"), stage.evaluation)
    (stage,) = rows["table_1", "ultralidar"].stages[0]
    assert jobs[f"test of {stage.name}"].words[2] == str(samples)
    assert stage.name not in jobs
    next(stage for stage in plan.stages if stage.on_features).config["scorer"]["num_scenes"] += 1
    again = {job.name: job for job in plan_jobs(plan)}
    assert again[test.name].content != test.content  # of other samples


def test_released_weights_are_sampled_and_measured_as_trained_ones(shipped, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    weights = tmp_path / "r3dpa.pt"
    weights.write_bytes(b"weights")
    # The other row has the settings of the reference.
    tables = shipped(table_1=["r3dpa"], table_4=["sit"])
    plan = plan_of("paper", tables=tables, released={"r3dpa": weights})
    jobs = {job.name: job for job in plan_jobs(plan)}
    (stage,) = rows_of(plan)["table_1", "r3dpa"].stages[0]
    sampled, test = jobs[stage.name].words, jobs[f"test of {stage.name}"].words
    assert sampled[sampled.index("--steps") + 1] == "256"
    assert sampled[sampled.index("--solver") + 1] == "euler_maruyama"
    assert sampled[sampled.index("--precision") + 1] == "bf16"
    assert sampled[sampled.index("--eta") + 1] == "1.0"
    assert test[test.index("--spaces") + 1] == "frid,fld,fsvd,fpvd,fwid,fgeo"
    assert test[test.index("--ckpt.frid") + 1] == "data/weights/frid.ckpt"


ROW = {"label": "x", "commands": {"a": "r3dpa fit joint"}}


def test_released_weights_are_sampled_without_the_shift_of_a_quality(tmp_path):
    """`r3dpa sample` shifts times where no shift is given."""
    settings = {"solver": "ab2", "steps": 32, "shift": 1.0}

    def resolve(words):
        return {
            "model": {"class_path": "r3dpa.modules.Joint"},
            "scorer": {"sampler": settings, "precision": "fp32"},
        }

    (tmp_path / "t.yaml").write_text(yaml.safe_dump({"caption": "c", "rows": {"a": ROW}}))
    weights = tmp_path / "weights.pt"
    weights.write_bytes(b"weights")
    given = {"tables": tmp_path / "t.yaml", "resolve": resolve, "released": {"a": weights}}
    (stage,) = rows_of(plan_of("demo", **given))["t", "a"].stages[0]
    assert stage.words[stage.words.index("--shift") + 1] == "1.0"
    settings |= {"solver": "euler_maruyama", "sde_last_time": 0.01}
    with pytest.raises(ValueError, match=r"ends the SDE at 0\.04, but the tests .* at 0\.01"):
        plan_of("demo", **given)


@pytest.mark.parametrize("joint", [" ", "="])
def test_each_seed_starts_from_its_own_checkpoint(joint, tmp_path):
    start = f"r3dpa fit flow_matching --model.init_args.init_from{joint}{{vae}}"
    row = {"label": "x", "commands": {"vae": "r3dpa fit vae_alignment", "flow": start}}
    table = {"caption": "c", "rows": {"a": row}}
    (tmp_path / "t.yaml").write_text(yaml.safe_dump(table, sort_keys=False))
    plan = plan_of("demo", (0, 1), tables=tmp_path / "t.yaml", resolve=words_alone)
    for vae, flow in rows_of(plan)["t", "a"].stages.values():
        assert any(str(vae.checkpoint) in word for word in flow.words)


def test_a_name_depends_on_the_content_of_weights_in_any_folder(tmp_path):
    weights = tmp_path / "Gewichte für RGB" / "rgb.pt"
    weights.parent.mkdir()
    row = {"label": "x", "commands": {"a": f"r3dpa fit joint --rgb_weights '{weights}'"}}
    (tmp_path / "t.yaml").write_text(yaml.safe_dump({"caption": "c", "rows": {"a": row}}))
    names = []
    for content in (b"one", b"two"):
        weights.write_bytes(content)
        plan_module._digest.cache_clear()
        plan = plan_of("demo", tables=tmp_path / "t.yaml", resolve=words_alone)
        names.append(plan.stages[0].name)
    assert names[0] != names[1]


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ({"commands": {}}, r"t\.yaml: b: .*'label'"),
        ({"label": "x", "colour": 1}, r"t\.yaml: b: .*'colour'"),
        (
            ROW | {"commands": {"a": "r3dpa fit x {fly}"}},
            "unknown {fly}; choose from image_vae, prior",
        ),
        (ROW | {"commands": {"a": "sample x"}}, "is no command `r3dpa fit STAGE"),
        (ROW | {"published": {"FID": 1.0}}, "unknown 'FID'; choose from FRID"),
    ],
)
def test_a_wrong_row_is_named(row, message, tmp_path):
    content = {"caption": "c", "rows": {"a": ROW, "b": row}}
    (tmp_path / "t.yaml").write_text(yaml.safe_dump(content))
    with pytest.raises(ValueError, match=message):
        plan_of("demo", tables=tmp_path / "t.yaml")


def test_tables_of_r3dpa_s_share_trainings_and_features(tmp_path, monkeypatch):
    """Six VAEs, twelve flows and three joint trainings of three seeds, after one prior."""
    monkeypatch.chdir(TABLES.parents[1])  # the scale names files of the checkout
    scale, seeds = TABLES / "scale" / "s.yaml", (0, 1, 2)
    plans = [
        make_plan(TABLES / name, scale, seeds, tmp_path, words_alone)
        for name in ("table_2", "table_3")
    ]
    names = {stage.name for plan in plans for stage in plan.stages}
    kinds = Counter(name.partition("-")[0] for name in names)
    assert kinds.pop("image_vae") == kinds.pop("rgb_pretraining") == 1
    assert kinds == {"vae_alignment": 6, "flow_matching": 12, "joint": 3}
    jobs = plan_jobs(make_plan(TABLES / "table_3", scale, seeds, tmp_path, resolved))
    data = str(tmp_path / "data.yaml")
    assert jobs[0].words == ["features", "--data", data, "--grid_sizes", "[[8, 32]]"]
    parser = features_parser("test")  # the options of the scans fit each other
    parser.instantiate(parser.parse_args(with_data_class(["--data", f"{tmp_path}/data.yaml"])))
