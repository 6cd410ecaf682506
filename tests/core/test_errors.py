"""Every message for a wrong combination, from the command line: exit code 2, the fix in the text, no torch needed."""

import pytest

TOY = {
    "lidarfw.backbone": {"toy_pillars": "toys:Pillars"},
    "lidarfw.neck": {"widen": "toys:Widen"},
    "lidarfw.head": {"peak": "toys:Peak", "refine": "toys:Refine", "coordinates": "toys:Coordinates",
                     "point_classes": "toys:PointClasses"},
    "lidarfw.loss": {"peak": "toys:PeakLoss", "contrast": "toys:Contrast", "edge": "toys:EdgeLoss"},
    "lidarfw.metric": {"count": "toys:Count"},
}  # fmt: skip


@pytest.fixture
def toys(site):
    site.install("toy-lidar", TOY, {})
    return site


def refused(site, *arguments, torch=False):
    """The message of a refused command."""
    done = site.run(*arguments)
    assert done.returncode == 2, done.stderr + done.stdout
    assert torch is None or ("torch imported" in done.stderr) is torch
    assert "Traceback" not in done.stderr
    return done.stderr


def test_a_missing_input_names_what_is_there_and_a_neck(site):
    text = refused(site, "train", "backbone=second", "neck=[]", "head=center")
    assert "head.center needs bev: BEV, but nothing before it provides one." in text
    assert "backbone.second            Voxels (several strides)" in text
    assert "fix: add one of: neck=height_compression" in text


@pytest.mark.parametrize("command", [("predict",), ("eval",), ("show",), ("bench",)])
def test_a_checkpoint_that_is_not_there(site, command):
    assert "there is no checkpoint nowhere.ckpt" in refused(site, *command, "nowhere.ckpt")


def test_two_candidates_must_be_chosen_between(toys):
    necks = ["neck=[widen]", "+neck.other.type=widen", "+neck.other.inputs.bev=backbone.toy_pillars"]
    text = refused(toys, "train", "backbone=toy_pillars", *necks, "head=peak")
    assert "head.peak could take bev: BEV from neck.widen or neck.other." in text
    assert "write head.peak.inputs: {bev: neck.other}" in text


def test_a_tap_without_its_head(toys):
    text = refused(toys, "train", "backbone=toy_pillars", "neck=[]", "head=peak", "loss=[peak,contrast]")
    assert (
        "loss.contrast needs localization: the BEV map of a head that predicts SceneCoords, and there is none" in text
    )
    assert "loss=[peak]" in text


def test_unequal_tap_widths(toys):
    branch = ["neck=[widen]", "+head.coordinates.inputs.bev=backbone.toy_pillars"]
    heads = ["head=[peak,coordinates]", "loss=[peak,contrast]"]
    text = refused(toys, "show", "backbone=toy_pillars", *branch, *heads, torch=True)
    assert "contrast needs equal tap widths, got detection 8 and localization 4" in text


def test_proposals_that_come_later(toys):
    text = refused(toys, "train", "backbone=toy_pillars", "neck=[]", "head=[refine,peak]")
    assert "head.refine needs proposals: Boxes, but nothing before it provides one." in text
    assert "'peak' provides Boxes but comes later: write head=[peak,refine]" in text


@pytest.mark.parametrize(
    ("override", "expected"),
    [
        ("head.center.chanels=3", ["head.center has no option 'chanels'", "did you mean 'channels'?"]),
        ("head.center.channels=big", ["head.center.channels", "'big' of type 'str' could not be converted to Integer"]),
        ("head=centre", ["no head named 'centre'", "center (lidarfw 0.1.0)", "did you mean 'center'?"]),
        ("hed=center", ["'hed'", "did you mean 'head'?"]),
        ("head.anchor.max_objects=3", ["head.anchor has options but is not selected", "fix: add head=anchor"]),
        ("neck=null", ["neck=[] selects none"]),
        ("head.center=anchor", ["head must hold components by name", "head=NAME"]),
        ("experiment=none_such", ["no experiment named 'none_such'"]),
        ("head=[center", ["cannot read the override 'head=[center'"]),
        ("dataset=[]", ["a run has one dataset"]),
        ("backbone.pillars.cell=[0,1]", ["backbone.pillars", "cell"]),
    ],
)
def test_wrong_overrides(site, override, expected):
    build = override.startswith("backbone.pillars.cell")
    text = refused(site, "show" if build else "train", override, torch=build)
    for part in expected:
        assert part in text


def test_a_component_declared_but_not_installed(site, tmp_path):
    project = tmp_path / "project"
    project.mkdir()
    declared = '[project.entry-points."lidarfw.head"]\nmsrm = "m:M"\nmsrm_lite = "m:Lite"\n'
    (project / "pyproject.toml").write_text(declared)
    site.install("lidarfw-msrm", {"lidarfw.head": {"msrm": "m:M"}}, {}, editable=project)
    text = refused(site, "train", "head=msrm_lite")
    assert f"head 'msrm_lite' is declared in {project}/pyproject.toml but not in the installed metadata" in text
    assert f"fix: pip install -e {project}" in text
    assert "declared but not installed" in site.run("list").stdout


def test_a_name_from_two_distributions(site):
    site.install("acme-lidar", {"lidarfw.head": {"center": "acme:Center"}}, {"acme.py": ""})
    text = refused(site, "train", "head=center")
    assert "head 'center' comes from two distributions: acme-lidar 1.0 and lidarfw 0.1.0" in text


def test_options_of_what_is_not_selected_are_dropped_and_a_typo_is_not(site):
    text = "# @package _global_\ndefaults:\n  - override /head: center\nhead: {anchor: {max_objects: 5}}\n"
    (site.folder / "own/experiment").mkdir(parents=True)
    (site.folder / "own/experiment/mine.yaml").write_text(text)
    (site.folder / "own/experiment/typo.yaml").write_text(text.replace("anchor", "anchr"))
    done = site.run("show", "--config-dir", "own", "experiment=mine")
    assert done.returncode == 0, done.stderr
    assert "head.anchor has options but is not selected (head=[center]); dropped" in done.stdout
    text = refused(site, "show", "--config-dir", "own", "experiment=typo")
    assert "head.anchr is set, but there is no head of that name" in text
    assert "did you mean 'anchor'?" in text


@pytest.mark.parametrize(
    ("source", "reason"),
    [
        ("import not_there\nclass Net:\n    pass\n", "No module named 'not_there', at site/broken.py:1"),
        ("class Net(:\n", "invalid syntax (broken.py, line 1), at site/broken.py:1"),
        ("import sys\nsys.exit(3)\n", "3, at site/broken.py:2"),
        ("x = 1\n", "has no attribute 'Net'"),
    ],
)
def test_a_broken_plugin_is_named_and_the_others_work(site, source, reason):
    site.install("lidarfw-taco", {"lidarfw.backbone": {"taco": "broken:Net"}}, {"broken.py": source})
    text = refused(site, "show", "backbone=taco", "neck=[]", "head=[]", torch=None)
    assert "backbone 'taco' (lidarfw-taco 1.0)" in text
    assert reason in text
    assert "taco" in site.run("list", "backbone").stdout
    assert site.run("show", "backbone=pillars").returncode == 0


def test_labels_that_the_dataset_lacks(toys):
    data = ["dataset=kitti", "dataset.kitti.root=nowhere"]
    text = refused(toys, "train", *data, "backbone=[]", "neck=[]", "head=point_classes", "loss=edge")
    assert "loss.edge needs PointLabels labels, dataset 'kitti' has Boxes" in text
    assert "datasets with them: " in text
    assert "synthetic" in text.partition("datasets with them: ")[2]


def test_unknown_slots_commands_and_help(site):
    assert "did you mean 'head'?" in refused(site, "list", "heads")
    done = site.run("--help")
    assert done.returncode == 0
    assert "torch imported" not in done.stderr
    assert all(name in done.stdout for name in ("train", "predict", "bench", "check"))
