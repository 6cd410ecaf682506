"""From a config to a model: `plan` decides who feeds whom, `build` makes the components in that order.

The four rules (docs/concepts.md): the parameters of `forward` say what a component needs; `__init__` gets their Specs
under the same names, and its keyword-only arguments are the config; `self.provides` is the Spec of what comes out; a
component sees what came before it, one that turns an X into an X replaces the X it took, and where two X are still
visible, `inputs: {parameter: component}` must choose.

`plan` reads declarations only: no torch, no weights, no data.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, cast

from omegaconf import DictConfig, OmegaConf

from lidarfw import __version__, declaration, registry
from lidarfw.config import LOSS_RESERVED, RESERVED, node_class, to_plain
from lidarfw.declaration import REQUIRED, Declaration, Parameter, kind_name
from lidarfw.errors import AssemblyError, ConfigError, LidarfwError
from lidarfw.interfaces import Dataset, Transform
from lidarfw.types import Boxes, DataSpec, Descriptors, PointLabels, Poses, SceneCoords, Spec, Tracks

if TYPE_CHECKING:
    from lidarfw.model import PerceptionModel

_FEATURE_SLOTS = ("backbone", "neck", "head")
_LATER_SLOTS = ("postprocessor", "filter", "tracker", "loss", "retriever", "metric")
_LABEL_OF: dict[Any, type] = {  # what must be labelled to learn a prediction
    Boxes: Boxes, PointLabels: PointLabels, SceneCoords: Poses, Poses: Poses, Descriptors: Poses, Tracks: Tracks,
}  # fmt: skip


@dataclass(frozen=True)
class Ref:
    """A value of an earlier component: its features, a head's raw output or its tap, or an input of the data."""

    producer: str  # "data.points", "backbone.second", "head.center"
    kind: Any  # type of the vocabulary, or path of an output class
    item: str = "value"  # value, output or tap
    several: bool = False  # a list of strides

    def __str__(self) -> str:
        return self.producer if self.item == "value" else f"{self.producer} ({self.item})"


@dataclass
class Step:
    """One component of the plan: its options and where its parameters come from."""

    slot: str
    name: str
    declared: Declaration
    options: dict[str, Any]
    takes: dict[str, list[Ref]] = field(default_factory=dict)  # no refs: an optional input that is not there
    weight: float = 1.0
    ramp: float = 0.0
    default_of: str = ""  # the head that brought it

    @property
    def id(self) -> str:
        """The name of the component in configs, messages and weights: "head.center"."""
        return f"{self.slot}.{self.name}"

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """What is wired: a tracker's forward and step alike."""
        extra = self.declared.trainable or ()
        return (*self.declared.takes, *(p for p in extra if p.name not in {t.name for t in self.declared.takes}))

    @property
    def replaces(self) -> list[Ref]:
        """The values that this component stands in for from now on: same kind in and out."""
        kinds = {kind for kind, _ in self.declared.gives}
        return [r for refs in self.takes.values() for r in refs if r.kind in kinds and r.item == "value"]


@dataclass
class Plan:
    """Who feeds whom."""

    config: dict[str, Any]  # resolved, with the defaults of the heads filled in
    data: DataSpec
    steps: list[Step]
    visible: list[Ref]  # predictions and features that nothing replaced
    warnings: list[str] = field(default_factory=list)

    def of(self, slot: str) -> list[Step]:
        """The steps of a slot, in order."""
        return [step for step in self.steps if step.slot == slot]

    @property
    def components(self) -> dict[str, str]:
        """Distribution of every component."""
        return {step.id: step.declared.entry.distribution for step in self.steps}

    @property
    def distributions(self) -> dict[str, str]:
        """Versions of the distributions that the plan uses."""
        used = {s.declared.entry.distribution: s.declared.entry.version for s in self.steps}
        return {"lidarfw": __version__, **{name: version for name, version in used.items() if version}}


# --- data ----------------------------------------------------------------------------------------------------------


def _plain(config: Mapping[str, Any] | DictConfig) -> dict[str, Any]:
    if isinstance(config, DictConfig):
        return to_plain(config)
    return dict(cast(Mapping[str, Any], config))


def make_dataset(config: Mapping[str, Any] | DictConfig, split: str) -> Dataset:
    """The dataset of a config for one split; nothing is read from disk yet."""
    plain = _plain(config)
    nodes = list(_nodes(plain, "dataset", []))
    if len(nodes) != 1:
        raise ConfigError(f"a run has one dataset, found {[n for n, _ in nodes] or 'none'}.\n  fix: dataset=NAME")
    name, node = nodes[0]
    dataset: Dataset = _create("dataset", name, {**node, "split": split})
    return dataset


def make_transforms(config: Mapping[str, Any] | DictConfig, training: bool) -> list[Transform]:
    """The transforms of a config in order; without augmentations unless `training`."""
    return list(named_transforms(config, training).values())


def named_transforms(config: Mapping[str, Any] | DictConfig, training: bool) -> dict[str, Transform]:
    """Those of `make_transforms` by name."""
    nodes = _nodes(_plain(config), "transform", [])
    made: dict[str, Transform] = {name: _create("transform", name, node) for name, node in nodes}
    return {name: transform for name, transform in made.items() if training or not transform.train_only}


def _create(slot: str, name: str, node: Mapping[str, Any]) -> Any:
    options = _options(slot, name, node, declaration.read(slot, node["type"]))
    try:
        return registry.load(slot, node["type"])(**options)
    except ValueError as error:
        raise ConfigError(f"{slot}.{name}: {error}") from error


def _data_spec(config: dict[str, Any]) -> DataSpec:
    spec = make_dataset(config, config.get("splits", {}).get("train", "train")).spec
    for transform in make_transforms(config, training=True):
        spec = transform.spec(spec)
    return spec


# --- plan ----------------------------------------------------------------------------------------------------------


def plan(config: Mapping[str, Any] | DictConfig, data: DataSpec | None = None) -> Plan:
    """Wire the components of a config. `data` stands in for the dataset, when a checkpoint is loaded.

    Raises AssemblyError, ConfigError, RegistryError, each with a fix.
    """
    plain = _plain(config)
    warnings: list[str] = []
    spec = _data_spec(plain) if data is None else data
    planner = _Planner(spec, plain, warnings)
    for slot in _FEATURE_SLOTS:
        for name, node in _nodes(plain, slot, warnings):
            planner.add(slot, name, node)
    planner.add_rest()
    return Plan(planner.config, spec, planner.steps, planner.visible, warnings)


def _nodes(config: Mapping[str, Any], slot: str, warnings: list[str]) -> Iterator[tuple[str, dict[str, Any]]]:
    nodes = config.get(slot) or {}
    if not (isinstance(nodes, dict) and all(isinstance(node, dict) for node in nodes.values())):
        raise ConfigError(f"{slot} must hold components by name, found {nodes!r}.\n  fix: {slot}=NAME or {slot}=[A,B]")
    selected = {name: node for name, node in nodes.items() if "type" in node}
    for name, node in nodes.items():
        if name in selected:
            yield name, node
        elif name in registry.names(slot):
            warnings.append(f"{slot}.{name} has options but is not selected ({slot}=[{','.join(selected)}]); dropped")
        else:
            near = registry.did_you_mean(name, [*selected, *registry.names(slot)])
            raise ConfigError(f"{slot}.{name} is set, but there is no {slot} of that name.{near}")


def _options(slot: str, name: str, node: Mapping[str, Any], declared: Declaration) -> dict[str, Any]:
    """The node's options, checked against the declaration and with its defaults; tuples where they are declared."""
    reserved = {*RESERVED, *(LOSS_RESERVED if slot == "loss" else ())}
    unknown = sorted(set(node) - reserved - set(declared.options))
    if unknown:
        near = registry.did_you_mean(unknown[0], list(declared.options))
        known = ", ".join(declared.options) or "none"
        raise ConfigError(f"{slot}.{name} has no option {unknown[0]!r}.\n  options of {node['type']!r}: {known}{near}")
    given = {key: value for key, value in node.items() if key != "inputs"}  # those are checked when they are wired
    try:
        typed = OmegaConf.merge(OmegaConf.structured(node_class(slot, node["type"])), given)
    except Exception as error:  # OmegaConf's validation errors share no base class with pickling and merge errors
        raise ConfigError(f"{slot}.{name}: {str(error).splitlines()[0]}") from error
    values: Any = OmegaConf.to_container(typed, resolve=True)
    missing = [o for o in declared.options if values[o] == "???"]
    if missing:
        raise ConfigError(f"{slot}.{name}.{missing[0]} must be set.\n  fix: {slot}.{name}.{missing[0]}=VALUE")
    return {o: _as_declared(values[o], declared.options[o].annotation) for o in declared.options}


def _as_declared(value: Any, annotation: Any) -> Any:
    if isinstance(value, list) and "tuple" in str(annotation):
        return tuple(tuple(v) if isinstance(v, list) else v for v in value)
    return value


class _Planner:
    """Keeps what is visible while components are added one after the other."""

    def __init__(self, data: DataSpec, config: dict[str, Any], warnings: list[str]) -> None:
        self.data, self.warnings = data, warnings
        self.config = {**config}
        self.steps: list[Step] = []
        self.produced: list[Ref] = [Ref(f"data.{name}", spec.kind) for name, spec in data.inputs.items()]
        self.visible = list(self.produced)

    def add(self, slot: str, name: str, node: Mapping[str, Any], bound: Step | None = None) -> Step:
        """Wire one component; `bound` is the head whose default it is."""
        declared = declaration.read(slot, node["type"])
        step = Step(slot, name, declared, _options(slot, name, node, declared))
        step.weight, step.ramp = float(node.get("weight", 1.0)), float(node.get("ramp", 0.0))
        step.default_of = bound.id if bound else ""
        chosen = {name: value for name, value in (node.get("inputs") or {}).items() if value is not None}
        self._check_inputs(step, chosen)
        for parameter in step.parameters:
            step.takes[parameter.name] = self._resolve(step, parameter, chosen.get(parameter.name), bound)
        self._check_data(step)
        self.steps.append(step)
        self._publish(step)
        return step

    def add_rest(self) -> None:
        """Postprocessors, filters, tracker, losses, retriever, metrics; what is not selected comes from the heads.

        The tracker comes before the losses, since a trainable one has losses of its own.
        """
        heads = [step for step in self.steps if step.slot == "head"]
        for slot in _LATER_SLOTS:
            nodes = list(_nodes(self.config, slot, self.warnings))
            for name, node in nodes:
                self.add(slot, name, node)
            if not nodes and slot in ("loss", "postprocessor", "metric"):
                self._add_defaults(slot, heads)
        self._warn_unlearned(heads)
        self._warn_unread()

    def _add_defaults(self, slot: str, heads: list[Step]) -> None:
        added: dict[str, Any] = {}
        for head in heads:
            final = any(ref.producer == head.id for ref in self.visible)
            for kind in head.declared.defaults.get(slot, []) if final or slot == "loss" else []:
                if slot == "metric" and _label_of(head) not in self.data.targets:
                    continue
                name = kind if kind not in added else f"{head.name}_{kind}"
                added[name] = {"type": kind}
                self.add(slot, name, added[name], bound=head)
                added[name]["inputs"] = {p: str(r[0].producer) for p, r in self.steps[-1].takes.items() if r}
        if added:
            self.config[slot] = added

    def _warn_unlearned(self, heads: list[Step]) -> None:
        learned = {
            ref.producer for step in self.steps if step.slot == "loss" for refs in step.takes.values() for ref in refs
        }
        for head in heads:
            if head.id not in learned and any(step.slot == "loss" for step in self.steps):
                self.warnings.append(f"{head.id} has no loss and will not learn")

    def _warn_unread(self) -> None:
        self.warnings += [f"nothing reads the output of {step.id}" for step in unread(self.steps)]

    def _publish(self, step: Step) -> None:
        if step.slot in ("loss", "metric", "filter", "retriever"):
            return
        replaced = step.replaces
        new = [Ref(step.id, kind, several=several) for kind, several in step.declared.gives]
        if step.slot == "postprocessor":  # an X -> X changes the prediction of its head, which stays the producer
            new = [ref for ref in new if not replaced]
        else:
            self.visible = [ref for ref in self.visible if ref not in replaced]
        self.produced += new
        self.visible += new

    # resolving one parameter

    def _resolve(self, step: Step, p: Parameter, chosen: Any, bound: Step | None) -> list[Ref]:
        if p.tap is not None:
            return [self._tap(step, p, chosen)]
        if isinstance(p.kind, str):
            return [self._output(step, p, chosen, bound)]
        if chosen is not None:
            return [self._named(step, p, name) for name in (chosen if isinstance(chosen, list) else [chosen])]
        found = [ref for ref in self.visible if ref.kind is p.kind]
        if bound is not None:
            found = [ref for ref in found if ref.producer == bound.id] or found
        if p.form == "dict" and found:
            return found
        if not found:
            if p.optional:
                return []
            raise AssemblyError(self._nothing_provides(step, p))
        if len(found) > 1:
            raise AssemblyError(self._ambiguous(step, p, found))
        return found

    def _named(self, step: Step, p: Parameter, name: str) -> Ref:
        found = [ref for ref in self.produced if name in (ref.producer, ref.producer.partition(".")[2])]
        fitting = [ref for ref in found if ref.kind is p.kind]
        if len(fitting) == 1:
            return fitting[0]
        gives = ", ".join(kind_name(ref.kind) for ref in found)
        state = f"gives {gives}, not {kind_name(p.kind)}" if found and not fitting else "is not before it"
        state = f"could be {' or '.join(str(r) for r in fitting)}" if fitting else state
        raise AssemblyError(f"{step.id}.inputs: {p.name}: {name!r} {state}.\n{self._available()}")

    def _heads(self) -> list[Step]:
        return [step for step in self.steps if step.slot in ("head", "tracker")]

    def _output(self, step: Step, p: Parameter, chosen: Any, bound: Step | None) -> Ref:
        found = [head for head in self._heads() if head.declared.output == p.kind]
        named = [h for h in found if chosen in (h.id, h.name) or (bound is not None and h.id == bound.id)]
        found = named or found
        if len(found) == 1:
            return Ref(found[0].id, p.kind, "output")
        if not found:
            without = ",".join(n for n in self.config.get(step.slot) or {} if n != step.name)
            raise AssemblyError(
                f"{step.id} needs {p.name}: {kind_name(p.kind)}, the output of a head that is not here.\n"
                f"{self._available()}\n  fix: {_heads_giving(p.kind)} or leave it out: {step.slot}=[{without}]"
            )
        names = " or ".join(h.id for h in found)
        raise AssemblyError(
            f"{step.id} could take {p.name} from {names}; write {step.id}.inputs: {{{p.name}: {found[0].id}}}"
        )

    def _tap(self, step: Step, p: Parameter, chosen: Any) -> Ref:
        predicts = p.tap
        found = [h for h in self._heads() if any(kind is predicts for kind, _ in h.declared.gives)]
        found = [h for h in found if chosen in (h.id, h.name)] if chosen is not None else found
        if len(found) == 1:
            return Ref(found[0].id, p.kind, "tap")
        wanted = f"{step.id} needs {p.name}: the {kind_name(p.kind)} map of a head that predicts {kind_name(predicts)}"
        if not found:
            without = ",".join(n for n in self.config.get(step.slot) or {} if n != step.name)
            raise AssemblyError(
                f"{wanted}, and there is none.\n{self._available()}\n  fix: add such a head, or {step.slot}=[{without}]"
            )
        names = " or ".join(h.id for h in found)
        raise AssemblyError(f"{wanted}: {names}; write {step.id}.inputs: {{{p.name}: {found[0].id}}}")

    # checks and messages

    def _check_inputs(self, step: Step, chosen: dict[str, Any]) -> None:
        names = [p.name for p in step.parameters]
        for name in chosen:
            if name not in names:
                near = registry.did_you_mean(name, names)
                raise AssemblyError(
                    f"{step.id}.inputs has {name!r}, but it takes {', '.join(names) or 'nothing'}.{near}"
                )

    def _check_data(self, step: Step) -> None:
        for p in step.parameters:
            if p.sweeps is not None and self.data.sweeps < p.sweeps:
                raise AssemblyError(f"{step.id} needs {p.sweeps} scans per frame, the dataset gives {self.data.sweeps}")
        if step.slot != "loss" or "targets" not in step.declared.special:
            return
        heads = [h for h in self._heads() if any(r.producer == h.id for refs in step.takes.values() for r in refs)]
        for label in {_label_of(head) for head in heads} - {None}:
            if label not in self.data.targets:
                raise AssemblyError(self._unlabelled(step, label))

    def _unlabelled(self, step: Step, label: Any) -> str:
        names = ", ".join(self.config.get("dataset") or {"the data": 0})
        has = ", ".join(sorted(kind_name(k) for k in self.data.targets)) or "no labels"
        fitting = ", ".join(_datasets_with(label)) or "none is installed"
        return (
            f"{step.id} needs {kind_name(label)} labels, dataset {names!r} has {has}.\n  datasets with them: {fitting}"
        )

    def _available(self) -> str:
        rows = [
            f"    {ref.producer:<26} {kind_name(ref.kind)}{' (several strides)' if ref.several else ''}"
            for ref in self.visible
        ]
        return "  available here:\n" + ("\n".join(rows) or "    nothing")

    def _nothing_provides(self, step: Step, p: Parameter) -> str:
        text = f"{step.id} needs {p}, but nothing before it provides one.\n{self._available()}"
        return text + (self._provided_later(step, p) or self._adapters(step, p))

    def _provided_later(self, step: Step, p: Parameter) -> str:
        nodes = [n for n, node in (self.config.get(step.slot) or {}).items() if node and "type" in node]
        later = nodes[nodes.index(step.name) + 1 :] if step.name in nodes else []
        for name in later:
            gives = declaration.read(step.slot, self.config[step.slot][name]["type"]).gives
            if any(kind is p.kind for kind, _ in gives):
                order = ",".join([name, *(n for n in nodes if n != name)])
                return f"\n  {name!r} provides {kind_name(p.kind)} but comes later: write {step.slot}=[{order}]"
        return ""

    def _adapters(self, step: Step, p: Parameter) -> str:
        here = {ref.kind for ref in self.visible}
        if step.slot == "head" and p.kind in _LABEL_OF:
            heads = [d.entry.name for d in declaration.all_declarations("head") if any(k is p.kind for k, _ in d.gives)]
            names = ", ".join(heads) or "none installed"
            return f"\n  fix: put a head before it that predicts {kind_name(p.kind)}: {names}"
        chains = list(_neck_chains(here, p.kind)) if step.slot in ("neck", "head") else []
        return f"\n  fix: add one of: {', '.join(chains)}" if chains else ""

    def _ambiguous(self, step: Step, p: Parameter, found: list[Ref]) -> str:
        names = " or ".join(ref.producer for ref in found)
        key = f"{step.id}.inputs"
        return (
            f"{step.id} could take {p} from {names}.\n  fix: write {key}: {{{p.name}: {found[-1].producer}}} "
            f"(on the command line: {key}.{p.name}={found[-1].producer})"
        )


def unread(steps: Sequence[Step]) -> list[Step]:
    """Backbones and necks whose output nothing reads.

    A metric does not count: it is no reason to compute something, and reads what would be there without.
    """
    readers = [step for step in steps if step.slot != "metric"]
    read = {ref.producer for step in readers for refs in step.takes.values() for ref in refs}
    return [step for step in steps if step.slot in ("backbone", "neck") and step.id not in read]


def _label_of(head: Step) -> type | None:
    kinds = [_LABEL_OF[kind] for kind, _ in head.declared.gives if kind in _LABEL_OF]
    return kinds[0] if kinds else None


def _neck_chains(here: set[Any], wanted: Any) -> Iterator[str]:
    """Installed necks, alone or two in a row, that turn what is here into `wanted`."""
    necks = declaration.all_declarations("neck")

    def fits(neck: Declaration, kinds: set[Any]) -> bool:
        return all(p.optional or p.kind in kinds for p in neck.takes)

    first = [n for n in necks if fits(n, here)]
    direct = [n for n in first if any(kind is wanted for kind, _ in n.gives)]
    if direct:
        yield from (f"neck={n.entry.name}" for n in direct)
        return
    for a in first:
        kinds = here | {kind for kind, _ in a.gives}
        for b in necks:
            if b is not a and fits(b, kinds) and any(kind is wanted for kind, _ in b.gives):
                yield f"neck=[{a.entry.name},{b.entry.name}]"


def _heads_giving(output: str) -> str:
    heads = [d.entry.name for d in declaration.all_declarations("head") if d.output == output]
    return f"add head={heads[0]}" if heads else "add the head that returns it"


def _datasets_with(label: type) -> list[str]:
    found = []
    for declared in declaration.all_declarations("dataset"):
        options = {n: ("" if o.default is REQUIRED else o.default) for n, o in declared.options.items()}
        try:
            spec = registry.load("dataset", declared.entry.name)(**options).spec
        except Exception:  # a dataset that cannot be asked without its options is not proposed
            continue
        if label in spec.targets:
            found.append(declared.entry.name)
    return found


# --- build ---------------------------------------------------------------------------------------------------------


def build(planned: Plan) -> PerceptionModel:
    """The model of a plan: components are made in order, each with the Specs of what it takes."""
    from lidarfw.model import PerceptionModel

    specs: dict[tuple[str, Any, str], Any] = {
        (f"data.{name}", spec.kind, "value"): spec for name, spec in planned.data.inputs.items()
    }
    modules: dict[str, Any] = {}
    for step in planned.steps:
        module = _build_step(step, specs, planned.data)
        modules[step.id] = module
        _publish_specs(step, module, specs)
    return PerceptionModel(planned, modules)


def _build_step(step: Step, specs: dict[tuple[str, Any, str], Any], data: DataSpec) -> Any:
    given = {p.name: _spec_of(step, p, specs) for p in step.parameters}
    arguments: dict[str, Any] = {}
    for name in step.declared.specs:
        if name != "data" and name not in given:
            raise AssemblyError(f"{step.id}: __init__ asks for the Spec {name!r}, which is no parameter of its forward")
        arguments[name] = data if name == "data" else given[name]
    cls = registry.load(step.slot, step.declared.entry.name)
    try:
        return cls(**arguments, **step.options)
    except (ValueError, RuntimeError, LidarfwError) as error:  # RuntimeError: torch's, of a size that cannot be
        kind = type(error) if isinstance(error, LidarfwError) else AssemblyError
        raise kind(f"{step.id}: {error}") from error


def _spec_of(step: Step, p: Parameter, specs: dict[tuple[str, Any, str], Any]) -> Any:
    found = [specs.get((r.producer, r.kind if r.item == "value" else None, r.item)) for r in step.takes[p.name]]
    if any(spec is None for spec in found):
        ref = step.takes[p.name][0]
        raise AssemblyError(f"{step.id} asks for the tap of {ref.producer}, which has none: its class sets no self.tap")
    if not found:
        return None
    if p.form == "dict":
        return {r.producer.partition(".")[2]: spec for r, spec in zip(step.takes[p.name], found, strict=True)}
    levels: list[Spec] = [s for spec in found for s in (spec if isinstance(spec, list) else [spec])]  # type: ignore[misc]
    if p.form == "list":
        return levels
    return _one_level(step, p, levels)


def _one_level(step: Step, p: Parameter, levels: list[Spec]) -> Spec:
    if p.stride is None:
        return max(levels, key=lambda spec: spec.stride)
    for spec in levels:
        if spec.stride == p.stride:
            return spec
    strides = [spec.stride for spec in levels]
    raise AssemblyError(f"{step.id} needs {p} at stride {p.stride}; {step.takes[p.name][0]} has strides {strides}")


def _publish_specs(step: Step, module: Any, specs: dict[tuple[str, Any, str], Any]) -> None:
    if not step.declared.gives:
        return
    provides = getattr(module, "provides", None)
    if provides is None and step.slot in ("tracker", "postprocessor"):
        return
    parts = provides if isinstance(provides, tuple) else (provides,)
    for part in parts:
        first = part[0] if isinstance(part, list) and part else part
        if not isinstance(first, Spec):
            raise AssemblyError(
                f"{step.id}: self.provides must be a Spec (or a list, or a tuple of them), found {part!r}"
            )
        if first.kind not in {kind for kind, _ in step.declared.gives}:
            raise AssemblyError(f"{step.id}: self.provides says {first}, its annotations say otherwise")
        specs[step.id, first.kind, "value"] = part
    if step.slot in ("head", "tracker"):
        specs[step.id, None, "output"] = provides
        specs[step.id, None, "tap"] = getattr(module, "tap", None)
