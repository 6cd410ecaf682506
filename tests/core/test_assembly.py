"""The four wiring rules, and the model that they give."""

import sys
from pathlib import Path

import pytest
import torch

from lidarfw import registry
from lidarfw.assembly import build, plan
from lidarfw.errors import AssemblyError, ConfigError
from lidarfw.types import Batch, Boxes, DataSpec, FrameMeta, Points, Poses, Spec, Targets

sys.path.insert(0, str(Path(__file__).parents[1] / "fixtures"))
import toys

DATA = DataSpec({"points": Spec(Points, 1)}, frozenset({Boxes, Poses}), ("Car",))


@pytest.fixture(autouse=True)
def toy_components():
    with registry.use(
        backbone={"toy_pillars": toys.Pillars, "levels": toys.Levels},
        neck={"widen": toys.Widen},
        head={"peak": toys.Peak, "refine": toys.Refine, "coordinates": toys.Coordinates, "stride2": toys.NeedsStride,
              "point_classes": toys.PointClasses},
        loss={"peak": toys.PeakLoss, "contrast": toys.Contrast, "edge": toys.EdgeLoss},
        postprocessor={"fit": toys.Fit},
        filter={"drop": toys.Drop},
        tracker={"number": toys.Number},
        metric={"count": toys.Count},
    ):  # fmt: skip
        yield


def nodes(**slots):
    """A config: slot=[names] or slot={name: node}."""
    config = {}
    for slot, value in slots.items():
        value = {name: {} for name in value} if isinstance(value, list) else value
        config[slot] = {name: {"type": name, **node} for name, node in value.items()}
    return config


def batch_of(*counts):
    batch = torch.cat([torch.full((n,), i) for i, n in enumerate(counts)]).long()
    xyz = torch.rand(len(batch), 3, generator=torch.Generator().manual_seed(0)) * 4
    points = Points(xyz, torch.ones(len(batch), 1), batch, len(counts))
    boxes = Boxes.from_tensor(torch.ones(1, 7), torch.zeros(1).long(), batch_size=len(counts))
    return Batch({"points": points}, Targets(boxes=boxes), [FrameMeta(str(i)) for i in range(len(counts))])


def wiring(planned, step):
    return {name: [str(r) for r in refs] for name, refs in next(s for s in planned.steps if s.id == step).takes.items()}


def test_a_chain_needs_no_inputs_and_replaces_what_it_took():
    planned = plan(
        nodes(backbone=["toy_pillars"], neck={"a": {"type": "widen"}, "b": {"type": "widen"}}, head=["peak"]), DATA
    )
    assert wiring(planned, "neck.b") == {"bev": ["neck.a"]}
    assert wiring(planned, "head.peak") == {"bev": ["neck.b"]}


def test_a_parallel_branch_states_its_input_and_then_the_head_must_choose():
    necks = {"a": {"type": "widen"}, "b": {"type": "widen", "inputs": {"bev": "backbone.toy_pillars"}}}
    with pytest.raises(AssemblyError, match=r"head\.peak could take bev: BEV from neck\.a or neck\.b") as error:
        plan(nodes(backbone=["toy_pillars"], neck=necks, head=["peak"]), DATA)
    assert "head.peak.inputs: {bev: neck.b}" in str(error.value)
    chosen = plan(nodes(backbone=["toy_pillars"], neck=necks, head={"peak": {"inputs": {"bev": "a"}}}), DATA)
    assert wiring(chosen, "head.peak") == {"bev": ["neck.a"]}


def test_channels_flow_through_specs_alone():
    for width in (3, 11):
        config = nodes(backbone=["toy_pillars"], neck={"widen": {"channels": width}}, head=["peak"])
        model = build(plan(config, DATA))
        assert model.head["peak"].conv.in_channels == width


def test_missing_input_names_a_neck_that_helps():
    with pytest.raises(AssemblyError) as error:
        plan(nodes(head=["peak"]), DATA)
    text = str(error.value)
    assert "head.peak needs bev: BEV, but nothing before it provides one" in text
    assert "data.points" in text
    assert "neck=points_to_bev" in text


def test_two_stage_heads_need_the_proposals_first():
    with pytest.raises(AssemblyError, match=r"'peak' provides Boxes but comes later: write head=\[peak,refine\]"):
        plan(nodes(backbone=["toy_pillars"], head=["refine", "peak"]), DATA)
    with pytest.raises(AssemblyError, match="put a head before it that predicts Boxes"):
        plan(nodes(backbone=["toy_pillars"], head=["refine"]), DATA)
    planned = plan(nodes(backbone=["toy_pillars"], head=["peak", "refine"]), DATA)
    model = build(planned).eval()
    results = model.predict(batch_of(5, 7))
    assert list(results[0].predictions) == ["head.refine"]  # it replaced the proposals
    assert results[1].of(Boxes).size.tolist() == [[4.0, 4.0, 4.0]]
    assert not model.head["refine"].saw_targets
    model.train()(batch_of(5))
    assert model.head["refine"].saw_targets


def test_a_list_takes_all_strides_and_one_takes_the_coarsest():
    class Both(toys.Peak):
        def __init__(self, voxels: list[Spec], one: Spec):
            torch.nn.Module.__init__(self)
            self.saw = [s.stride for s in voxels], one.stride
            self.provides = Spec(Boxes)

        def forward(self, voxels: list[toys.Voxels], one: toys.Voxels) -> toys.PeakOutput:
            self.ran = [v.stride for v in voxels], one.stride
            return toys.PeakOutput(torch.zeros(1, 1, 1, 1), None)

    with registry.use(head={"both": Both}):
        model = build(plan(nodes(backbone=["levels"], head=["both"]), DATA))
        model(batch_of(3))
        assert model.head["both"].saw == ([1, 2, 4], 4)
        assert model.head["both"].ran == ([1, 2, 4], 4)


def test_a_stride_constraint_is_checked_at_build():
    with pytest.raises(
        AssemblyError, match=r"head\.stride2 needs bev: BEV at stride 2; backbone\.levels has strides \[4\]"
    ):
        build(plan(nodes(backbone=["levels"], head=["stride2"]), DATA))


def test_taps_find_the_heads_by_what_they_predict():
    config = nodes(backbone=["toy_pillars"], head=["peak", "coordinates"], loss=["peak", "contrast"])
    model = build(plan(config, DATA))
    batch = batch_of(4)
    terms = model.losses(model(batch), batch)
    assert set(terms) == {"peak", "contrast"}
    with pytest.raises(AssemblyError, match=r"map of a head that predicts SceneCoords, and there is none") as error:
        plan(nodes(backbone=["toy_pillars"], head=["peak"], loss=["peak", "contrast"]), DATA)
    assert "loss=[peak]" in str(error.value)


def test_a_loss_of_weight_zero_is_not_run_and_a_ramp_grows():
    config = nodes(backbone=["toy_pillars"], head=["peak"], loss={"peak": {"weight": 2.0, "ramp": 0.5}})
    model = build(plan(config, DATA))
    batch = batch_of(4)
    outputs = model(batch)
    full = model.losses(outputs, batch, 1.0)["peak"]["score"]
    assert torch.allclose(model.losses(outputs, batch, 0.25)["peak"]["score"], full / 2)
    assert model.losses(outputs, batch, 0.0) == {}


def test_defaults_of_heads_are_bound_and_stand_in_the_config():
    heads = {"a": {"type": "peak"}, "b": {"type": "peak"}}
    planned = plan(nodes(backbone=["toy_pillars"], head=heads), DATA)
    assert planned.config["loss"] == {
        "peak": {"type": "peak", "inputs": {"peak": "head.a"}},
        "b_peak": {"type": "peak", "inputs": {"peak": "head.b"}},
    }
    assert wiring(planned, "metric.b_count") == {"boxes": ["head.b"]}
    again = plan({**planned.config}, DATA)  # as a checkpoint stores it
    assert [s.id for s in again.steps] == [s.id for s in planned.steps]
    assert [s.takes for s in again.steps] == [s.takes for s in planned.steps]


def test_a_postprocessor_may_give_another_kind():
    config = nodes(backbone=["toy_pillars"], head=["coordinates"], postprocessor=["fit"])
    result = build(plan(config, DATA)).eval().predict(batch_of(2, 3))[1]
    assert result.of(Poses).matrix.shape == (1, 4, 4)


def test_metrics_count_frames_with_their_own_targets():
    model = build(plan(nodes(backbone=["toy_pillars"], head=["peak"]), DATA)).eval()
    model.update_metrics(model.predict(batch_of(3, 4)))
    assert model.compute_metrics() == {"count/boxes": 2.0, "count/labels": 1.0}
    assert model.monitor == "count/boxes"
    assert not any("count" in key for key in model.state_dict())


def test_a_tracker_that_needs_poses_is_refused_without_them():
    config = nodes(backbone=["toy_pillars"], head=["peak"], tracker=["number"])
    with pytest.raises(AssemblyError, match=r"tracker\.number needs pose: Poses, but nothing before it provides one"):
        plan(config, DATA)
    with_pose = DataSpec({**DATA.inputs, "pose": Spec(Poses)}, DATA.targets, DATA.classes)
    planned = plan(config, with_pose)
    assert wiring(planned, "tracker.number") == {"boxes": ["head.peak"], "pose": ["data.pose"]}


def test_labels_that_the_dataset_lacks_are_named_with_datasets_that_have_them():
    with pytest.raises(AssemblyError) as error:
        plan(nodes(head=["point_classes"], loss=["edge"]), DATA)
    assert "loss.edge needs PointLabels labels" in str(error.value)
    assert "synthetic" in str(error.value)


@pytest.mark.parametrize(
    ("node", "message"),
    [
        ({"sise": 3.0}, r"head\.peak has no option 'sise'.*\n.*size.*\n.*did you mean 'size'"),
        ({"size": "big"}, r"head\.peak: .*could not be converted to Float"),
        ({"inputs": {"bev": "nothing"}}, r"head\.peak\.inputs: bev: 'nothing' is not before it"),
        ({"inputs": {"bve": "toy_pillars"}}, r"head\.peak\.inputs has 'bve', but it takes bev"),
        ({"inputs": {"bev": "data.points"}}, r"'data\.points' gives Points, not BEV"),
    ],
)
def test_wrong_nodes_are_named(node, message):
    with pytest.raises((AssemblyError, ConfigError), match=message):
        plan(nodes(backbone=["toy_pillars"], head={"peak": node}), DATA)


def test_options_of_a_component_that_is_not_selected_are_dropped_with_a_warning():
    config = nodes(backbone=["toy_pillars"], head=["peak"])
    config["head"]["refine"] = {"factor": 3.0}
    assert plan(config, DATA).warnings == ["head.refine has options but is not selected (head=[peak]); dropped"]
    config["head"]["refin"] = {"factor": 3.0}
    with pytest.raises(ConfigError, match="did you mean 'refine'"):
        plan(config, DATA)


def test_a_neck_that_nothing_reads_is_pointed_out():
    necks = {"widen": {}, "idle": {"type": "widen", "inputs": {"bev": "backbone.toy_pillars"}}}
    heads = {"peak": {"inputs": {"bev": "neck.widen"}}}
    planned = plan(nodes(backbone=["toy_pillars"], neck=necks, head=heads), DATA)
    assert planned.warnings == ["nothing reads the output of neck.idle"]


def test_parameters_carry_config_names():
    model = build(plan(nodes(backbone=["toy_pillars"], neck=["widen"], head=["peak"]), DATA))
    assert {"backbone.toy_pillars.scale", "neck.widen.conv.weight", "head.peak.conv.bias"} <= set(model.state_dict())
