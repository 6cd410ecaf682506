"""What a component takes, gives and can be set to, read from its signatures.

The source is read without importing it, since importing a network means importing torch, and a wrong
combination should be refused at once. Where the source cannot be read that way (a computed default, a base
class out of reach), the class is imported instead and gives the same declaration.
"""

from __future__ import annotations

import ast
import functools
import importlib
import importlib.util
import inspect
import math
import types
import typing
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from lidarfw import registry
from lidarfw.errors import RegistryError
from lidarfw.types import VOCABULARY, FrameMeta, FrameResult, Stride, Sweeps, Tap, Targets

REQUIRED: Any = inspect.Parameter.empty
_ENTRANCE = {"filter": "step", "tracker": "step", "metric": "update", "retriever": "build"}  # else forward
_SPECIAL = ("targets", "meta", "progress")
_REAL_MODULES = ("typing", "typing_extensions", "collections.abc", "math", "lidarfw.types")


@dataclass(frozen=True)
class Parameter:
    """One thing that a component needs."""

    name: str
    kind: Any  # a type of the vocabulary, or the path of another component's output class
    form: Literal["one", "list", "dict"] = "one"
    optional: bool = False
    constraints: tuple[Any, ...] = ()

    @property
    def tap(self) -> type | None:
        """The kind predicted by the head whose tap is asked for."""
        return next((c.kind for c in self.constraints if isinstance(c, Tap)), None)

    @property
    def stride(self) -> int | None:
        return next((c.value for c in self.constraints if isinstance(c, Stride)), None)

    @property
    def sweeps(self) -> int | None:
        return next((c.value for c in self.constraints if isinstance(c, Sweeps)), None)

    def __str__(self) -> str:
        name = kind_name(self.kind)
        return f"{self.name}: {name if self.form == 'one' else f'{self.form}[{name}]'}"


@dataclass(frozen=True)
class Option:
    """A keyword-only argument of `__init__`."""

    annotation: Any
    default: Any = REQUIRED


@dataclass(frozen=True)
class Declaration:
    """A component as its signatures declare it."""

    entry: registry.Entry
    file: str
    line: int
    doc: str
    specs: tuple[str, ...]  # positional parameters of __init__
    options: dict[str, Option]
    takes: tuple[Parameter, ...]
    special: tuple[str, ...]  # which of targets, meta, progress it takes
    gives: tuple[tuple[type, bool], ...]  # (kind, several levels?), in the order in which they are returned
    output: str = ""  # path of the class that the forward of a head or trainable tracker returns
    defaults: dict[str, list[str]] = field(default_factory=dict)
    trainable: tuple[Parameter, ...] | None = None  # parameters of a tracker's forward, where it has one


def kind_name(kind: Any) -> str:
    """Short name of a kind, as messages show it."""
    return kind.__name__ if isinstance(kind, type) else str(kind).rpartition(".")[2]


@functools.lru_cache(maxsize=512)
def _read(entry: registry.Entry) -> Declaration:
    return from_source(entry) or _declare(entry, _ImportedClass(registry.load(entry.slot, entry.name)))


def from_source(entry: registry.Entry) -> Declaration | None:
    """The declaration by the source alone, or None where the source cannot be understood without running it."""
    module, _, name = entry.value.partition(":")
    try:
        return _declare(entry, _StaticClass(*_Module.of(module).find_class(name)))
    except _NotStaticError:
        return None


def read(slot: str, name: str) -> Declaration:
    """The declaration of a registered component or of "package.module:Class"."""
    local = registry.given(slot, name)
    if local is not None:
        return _declare(registry.find(slot, name), _ImportedClass(local))
    return _read(registry.find(slot, name))


def of_class(slot: str, cls: type) -> Declaration:
    """The declaration of a class at hand, from the class itself."""
    return _declare(registry.Entry(slot, cls.__name__, f"{cls.__module__}:{cls.__qualname__}"), _ImportedClass(cls))


def _declare(entry: registry.Entry, source: _StaticClass | _ImportedClass) -> Declaration:
    init = source.signature("__init__") or Signature({}, None)
    entrance = source.signature(_ENTRANCE.get(entry.slot, "forward")) or Signature({}, None)
    forward = source.signature("forward") if entry.slot in ("head", "tracker") else None
    decode = source.signature("decode") if entry.slot == "head" else None
    skip = ("state", "frame") if entry.slot in ("filter", "tracker") else ()
    takes = _parameters(entry, entrance, skip) if entry.slot not in ("dataset", "transform") else ()
    output = forward.returns if forward is not None else None
    returns = decode.returns if decode is not None else entrance.returns
    return Declaration(
        entry,
        source.file,
        source.line,
        source.doc,
        tuple(name for name, p in init.parameters.items() if not p.keyword),
        {name: Option(p.annotation, p.default) for name, p in init.parameters.items() if p.keyword},
        takes,
        tuple(name for name in _SPECIAL if name in entrance.parameters),
        () if entry.slot in ("loss", "metric", "filter", "retriever") else _gives(returns, entry.slot),
        _path(output) if isinstance(output, type) else "",
        source.attribute("defaults") or {},
        _parameters(entry, forward, ()) if entry.slot == "tracker" and forward is not None else None,
    )


def _gives(returns: Any, slot: str) -> tuple[tuple[type, bool], ...]:
    from lidarfw.types import Tracks

    if slot == "tracker":
        return ((Tracks, False),)
    parts = get_args(returns) if get_origin(returns) is tuple else (returns,)
    found = []
    for part in parts:
        several = get_origin(part) is list
        kind = get_args(part)[0] if several else part
        if isinstance(kind, type) and kind in VOCABULARY.values():
            found.append((kind, several))
    return tuple(found)


def _parameters(entry: registry.Entry, signature: Signature, skip: tuple[str, ...]) -> tuple[Parameter, ...]:
    names = [n for n in signature.parameters if n not in skip and n not in _SPECIAL]
    return tuple(_parameter(entry, n, signature.parameters[n].annotation) for n in names)


def _parameter(entry: registry.Entry, name: str, annotation: Any) -> Parameter:
    constraints: tuple[Any, ...] = ()
    optional = False
    form: Literal["one", "list", "dict"] = "one"
    while get_origin(annotation) in (Annotated, Union, types.UnionType, list, dict):
        origin, arguments = get_origin(annotation), get_args(annotation)
        if origin is Annotated:
            annotation, constraints = arguments[0], (*constraints, *arguments[1:])
        elif origin is list:
            annotation, form = arguments[0], "list"
        elif origin is dict:
            annotation, form = arguments[1], "dict"
        else:
            optional = optional or type(None) in arguments
            annotation = next(a for a in arguments if a is not type(None))
    if not isinstance(annotation, type):
        raise RegistryError(
            f"{entry.slot} {entry.name!r}: parameter {name!r} of forward needs a type of lidarfw.types or a head's "
            f"output class as annotation, found {annotation!r} in {entry.value}"
        )
    kind = annotation if annotation in (*VOCABULARY.values(), Targets, FrameMeta, FrameResult) else _path(annotation)
    return Parameter(name, kind, form, optional, constraints)


def _path(cls: type) -> str:
    return str(getattr(cls, "__path_in_source__", f"{cls.__module__}.{cls.__qualname__}"))


# --- signatures, from a class or from its source ----------------------------------------------------------------


@dataclass(frozen=True)
class SignatureParameter:
    """Annotation and default of one argument."""

    annotation: Any
    default: Any
    keyword: bool


@dataclass(frozen=True)
class Signature:
    """Arguments of a method without self, *args and **kwargs."""

    parameters: dict[str, SignatureParameter]
    returns: Any


class _ImportedClass:
    """Signatures of an imported class."""

    def __init__(self, cls: type) -> None:
        self.cls = cls
        self.doc = inspect.getdoc(cls) or ""
        try:
            self.file, self.line = inspect.getsourcefile(cls) or "", inspect.getsourcelines(cls)[1]
        except (OSError, TypeError):
            self.file, self.line = "", 0

    def attribute(self, name: str) -> Any:
        return getattr(self.cls, name, None)

    def signature(self, method: str) -> Signature | None:
        owner = next((c for c in self.cls.__mro__ if method in vars(c)), object)
        if owner is object or owner.__module__.startswith(("torch.", "torchmetrics.", "lidarfw.interfaces")):
            return None
        function = vars(owner)[method]
        hints = typing.get_type_hints(function, include_extras=True)
        found = {}
        for name, p in list(inspect.signature(function).parameters.items())[1:]:
            if p.kind not in (p.VAR_POSITIONAL, p.VAR_KEYWORD):
                found[name] = SignatureParameter(hints.get(name, Any), p.default, p.kind is p.KEYWORD_ONLY)
        return Signature(found, hints.get("return"))


class _NotStaticError(Exception):
    """The source cannot be understood without running it."""


class _StaticClass:
    """Signatures of a class, from its source."""

    def __init__(self, module: _Module, node: ast.ClassDef) -> None:
        self.module, self.node = module, node
        self.file, self.line = str(module.file), node.lineno
        self.doc = ast.get_docstring(node) or ""

    def _lineage(self) -> Iterator[_StaticClass]:
        yield self
        for base in self.node.bases:
            name = ast.unparse(base)
            if self.module.origin(name).startswith(("lidarfw.interfaces", "abc", "typing")):
                continue
            if not isinstance(base, ast.Name):
                raise _NotStaticError(name)
            yield from _StaticClass(*self.module.find_class(name))._lineage()

    def attribute(self, name: str) -> Any:
        for cls in self._lineage():
            for statement in cls.node.body:
                if not isinstance(statement, ast.Assign | ast.AnnAssign) or statement.value is None:
                    continue
                target = statement.target if isinstance(statement, ast.AnnAssign) else statement.targets[0]
                if isinstance(target, ast.Name) and target.id == name:
                    return cls.module.evaluate(statement.value)
        return None

    def signature(self, method: str) -> Signature | None:
        for cls in self._lineage():
            for statement in cls.node.body:
                if isinstance(statement, ast.FunctionDef) and statement.name == method:
                    return cls._signature(statement)
        return None

    def _signature(self, function: ast.FunctionDef) -> Signature:
        arguments = function.args
        if function.decorator_list and any(ast.unparse(d) != "abstractmethod" for d in function.decorator_list):
            decorators = {ast.unparse(d) for d in function.decorator_list}
            if not decorators <= {"override", "torch.no_grad()", "abstractmethod"}:
                raise _NotStaticError(function.name)
        positional = [*arguments.posonlyargs, *arguments.args][1:]
        missing = [None] * (len(positional) - len(arguments.defaults))
        rows = [
            *zip(positional, [*missing, *arguments.defaults][-len(positional) or None :], [False] * len(positional))
        ]
        rows += zip(arguments.kwonlyargs, arguments.kw_defaults, [True] * len(arguments.kwonlyargs))
        evaluate = self.module.evaluate
        found = {}
        for argument, default, keyword in rows:
            annotation = Any if argument.annotation is None else evaluate(argument.annotation)
            value = REQUIRED if default is None else evaluate(default)
            found[argument.arg] = SignatureParameter(annotation, value, keyword)
        return Signature(found, None if function.returns is None else evaluate(function.returns))


class _Module:
    """The top level of a source file: its classes, constants and where its names come from."""

    def __init__(self, name: str) -> None:
        try:
            spec = importlib.util.find_spec(name)
            if spec is None or spec.origin is None or not spec.origin.endswith(".py"):
                raise _NotStaticError(name)
            self.file = Path(spec.origin)
            tree = ast.parse(self.file.read_text(encoding="utf-8"))
        except (ImportError, OSError, SyntaxError, ValueError) as error:
            raise _NotStaticError(name) from error
        self.name = name
        self.package = name if spec.submodule_search_locations is not None else name.rpartition(".")[0]
        self.classes: dict[str, ast.ClassDef] = {}
        self.values: dict[str, ast.expr] = {}
        self.imports: dict[str, tuple[str, str]] = {}  # local name -> (module, name in it or "")
        self._index(tree.body)

    @classmethod
    @functools.cache
    def of(cls, name: str) -> _Module:
        return cls(name)

    def _index(self, body: list[ast.stmt]) -> None:
        for statement in body:
            if isinstance(statement, ast.ClassDef):
                self.classes[statement.name] = statement
            elif isinstance(statement, ast.Assign) and isinstance(statement.targets[0], ast.Name):
                self.values[statement.targets[0].id] = statement.value
            elif isinstance(statement, ast.AnnAssign) and isinstance(statement.target, ast.Name) and statement.value:
                self.values[statement.target.id] = statement.value
            elif isinstance(statement, ast.Import):
                self.imports |= {a.asname or a.name.partition(".")[0]: (a.name, "") for a in statement.names}
            elif isinstance(statement, ast.ImportFrom):
                source = importlib.util.resolve_name("." * statement.level + (statement.module or ""), self.package)
                self.imports |= {a.asname or a.name: (source, a.name) for a in statement.names}
            elif isinstance(statement, ast.If):  # TYPE_CHECKING
                self._index(statement.body)

    def origin(self, name: str) -> str:
        """Module that a name of this one comes from."""
        return self.imports[name][0] if name in self.imports else self.name

    def find_class(self, name: str) -> tuple[_Module, ast.ClassDef]:
        """A class that is defined or imported here, in the module that defines it."""
        if name in self.classes:
            return self, self.classes[name]
        if name in self.imports and self.imports[name][1]:
            module, attribute = self.imports[name]
            return _Module.of(module).find_class(attribute)
        raise _NotStaticError(name)

    def evaluate(self, expression: ast.expr) -> Any:
        """The value of an annotation or default; classes of other modules stand for themselves by their path."""
        if isinstance(expression, ast.Constant) and isinstance(expression.value, str) and " " not in expression.value:
            try:  # a string annotation such as "Output" names a class; any other string is a value
                return self._resolve(expression.value) if expression.value in self.classes else expression.value
            except _NotStaticError:
                return expression.value
        names = {n.id for n in ast.walk(expression) if isinstance(n, ast.Name)}
        namespace = {name: self._resolve(name) for name in names}
        try:
            return eval(compile(ast.Expression(expression), str(self.file), "eval"), {"__builtins__": {}}, namespace)
        except Exception as error:
            raise _NotStaticError(ast.unparse(expression)) from error

    def _resolve(self, name: str) -> Any:
        if name in _BUILTINS:
            return _BUILTINS[name]
        if name in self.classes:
            return _stand_in(f"{self.name}.{name}")
        if name in self.values:
            return self.evaluate(self.values[name])
        if name not in self.imports:
            raise _NotStaticError(name)
        module, attribute = self.imports[name]
        if module.startswith(_REAL_MODULES):
            real = importlib.import_module(module)
            return getattr(real, attribute) if attribute else real
        if not attribute:
            raise _NotStaticError(name)
        if module.startswith("torch"):
            return _stand_in(f"{module}.{attribute}")
        return _Module.of(module)._resolve(attribute)


_BUILTINS: dict[str, Any] = {t.__name__: t for t in (int, float, bool, str, list, dict, tuple, set, type, object)}
_BUILTINS |= {"math": math}


@functools.cache
def _stand_in(path: str) -> type:
    return type(path.rpartition(".")[2], (), {"__path_in_source__": path})


def all_declarations(slot: str) -> list[Declaration]:
    """Declarations of the components of a slot; those that cannot be read are left out."""
    found = []
    for name in registry.names(slot):
        try:
            found.append(read(slot, name))
        except RegistryError:
            continue
    return found
