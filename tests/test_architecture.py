"""The structure of the package: one chain of imports, documented public names, and no private names of others."""

import ast
import dataclasses
import graphlib
import importlib
import inspect
import re
from collections.abc import Iterator
from pathlib import Path
from typing import get_origin

import pytest
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.vec_env import VecEnv

import sb3_reinforce

ROOT = Path(sb3_reinforce.__file__).parent
# The entries of the top folder: each imports only from those before its own line
CHAIN = (
    {"common"},
    {"policies", "envs"},
    {"estimation"},
    {"sampling"},
    {"reinforce", "finite_difference"},
    {"recurrent"},
    {"__init__"},
    {"diagnostics", "zoo"},
    {"__main__"},
)
# The private names of other packages, with the reason for each; ARCHITECTURE.md repeats them. This may only shrink
FOREIGN = {
    "_hooks": "a module with hooks in PyTorch's dictionaries, which have no public names, must be called itself",
    "_final_obs": "Gymnasium's vector environments mask this entry of their infos by a key with an underscore",
    "_final_info": "as _final_obs",
    "_episode": "as _final_obs",
}
MAX_LINES = 250
# The docstring of an algorithm's class is the reference of its arguments, and its update is read in one place
LONGER = {"reinforce.py", "finite_difference.py"}
PACKAGES = ("", ".diagnostics", ".diagnostics.plots", ".estimation", ".recurrent", ".zoo")
PUBLIC = tuple(f"sb3_reinforce{package}" for package in PACKAGES)
PRIVATE = re.compile(r"_[a-z]\w*")

TREES = {
    path.relative_to(ROOT).as_posix(): ast.parse(path.read_text(encoding="utf-8"))
    for path in sorted(ROOT.rglob("*.py"))
}
NODES = [(path, node) for path, tree in TREES.items() for node in ast.walk(tree)]


def module_of(path: str) -> str:
    """The name of a file's module, where a package is its ``__init__``."""
    return ".".join(("sb3_reinforce", *Path(path).with_suffix("").parts))


MODULES = {module_of(path): path for path in TREES}


def imported_files(tree: ast.AST) -> Iterator[str]:
    """The files of the package that a file imports, in a function or for types too."""
    for node in ast.walk(tree):
        names = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports are absolute"
            names = [f"{node.module}.{alias.name}" for alias in node.names]
        for name in names:
            parent = name.rpartition(".")[0]
            candidates = (name, f"{name}.__init__", parent, f"{parent}.__init__")
            # A module, or else the module that defines the name
            yield from [MODULES[module] for module in candidates if module in MODULES][:1]


IMPORTS = {path: {*imported_files(tree)} - {path} for path, tree in TREES.items()}


def entry_of(path: str) -> str:
    """The entry of the top folder to which a file belongs."""
    return Path(path).with_suffix("").parts[0]


def test_imports_follow_the_chain() -> None:
    level = {entry: number for number, entries in enumerate(CHAIN) for entry in entries}
    assert {entry_of(path) for path in TREES} <= level.keys()
    against = [
        f"{path} imports {target}"
        for path, targets in IMPORTS.items()
        for target in targets
        if entry_of(path) != entry_of(target) and level[entry_of(path)] <= level[entry_of(target)]
    ]
    assert not against, "\n".join(against)


def test_no_file_imports_itself_by_way_of_others() -> None:
    graphlib.TopologicalSorter(IMPORTS).prepare()


def names_for_subclasses() -> set[str]:
    """The private names that a subclass sees in the classes of Stable-Baselines3 that this package extends."""
    classes = {base for cls in (OnPolicyAlgorithm, ActorCriticPolicy, BaseCallback, VecEnv) for base in cls.__mro__}
    sources = [inspect.getsource(base) for base in classes if base.__module__.startswith("stable_baselines3")]
    return {name for source in sources for name in re.findall(r"(?:self\.|def |[(,]\s*)(_[a-z]\w*)", source)}


def own_names() -> set[str]:
    """The names that the package defines."""
    names = set()
    for _, node in NODES:
        if isinstance(node, (ast.FunctionDef, ast.ClassDef)):
            names.add(node.name)
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            names.add(node.id)
        elif isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store) and is_own(node.value):
            names.add(node.attr)
    return names


def is_own(receiver: ast.expr) -> bool:
    """Whether an attribute is read from the instance or class itself."""
    return ast.unparse(receiver) in ("self", "cls", "super()")


def foreign_names() -> dict[str, list[str]]:
    """Every private attribute of another object, and every text that can name one, with its places."""
    found: dict[str, list[str]] = {}
    parts_of_texts = {id(part) for _, node in NODES if isinstance(node, ast.JoinedStr) for part in node.values}
    for path, node in NODES:
        name = ""
        if isinstance(node, ast.Attribute) and not is_own(node.value):
            name = node.attr
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in parts_of_texts:
            name = node.value
        elif isinstance(node, ast.ImportFrom) and not str(node.module).startswith("sb3_reinforce"):
            name = next((alias.name for alias in node.names if PRIVATE.fullmatch(alias.name)), "")
        if PRIVATE.fullmatch(name):
            found.setdefault(name, []).append(f"{path}:{node.lineno}")
    return found


def test_private_names_of_others_are_those_with_a_documented_reason() -> None:
    allowed = names_for_subclasses() | own_names()
    found = {name: places for name, places in foreign_names().items() if name not in allowed}
    unexplained = [f"{name}: {', '.join(places)}" for name, places in found.items() if name not in FOREIGN]
    assert not unexplained, "\n".join(unexplained)
    assert found.keys() == FOREIGN.keys()


def test_nothing_private_of_others_is_replaced() -> None:
    allowed = names_for_subclasses() | own_names()
    replaced = []
    for path, node in NODES:
        name: ast.AST | None = None
        if isinstance(node, ast.Attribute) and not isinstance(node.ctx, ast.Load) and not is_own(node.value):
            name = ast.Constant(node.attr)
        elif isinstance(node, ast.Subscript) and not isinstance(node.ctx, ast.Load):
            # vars(thing)["name"] = ... and thing.__dict__["name"] = ...
            name = node.slice if re.search(r"^vars\(|\.__dict__$", ast.unparse(node.value)) else None
        elif isinstance(node, ast.Call) and ast.unparse(node.func) in ("setattr", "delattr", "object.__setattr__"):
            name = node.args[1]
        if isinstance(name, ast.Constant) and PRIVATE.fullmatch(name.value) and name.value not in allowed:
            replaced.append(f"{path}:{node.lineno} {name.value}")
    assert not replaced, "\n".join(replaced)


def test_the_package_mocks_nothing() -> None:
    texts = [ast.unparse(node) for _, node in NODES if isinstance(node, (ast.Import, ast.ImportFrom))]
    assert not any(re.match(r"(import|from) unittest\b", text) for text in texts)


def test_diagnostics_read_only_what_is_public() -> None:
    private = [
        f"{path}:{node.lineno} {ast.unparse(node)}"
        for path, node in NODES
        if isinstance(node, ast.Attribute)
        and PRIVATE.fullmatch(node.attr)
        and entry_of(path) == "diagnostics"
        and not is_own(node.value)
    ]
    assert not private, "\n".join(private)


def test_files_are_short() -> None:
    lengths = {path: len((ROOT / path).read_text(encoding="utf-8").splitlines()) for path in TREES.keys() - LONGER}
    too_long = {path: length for path, length in lengths.items() if length >= MAX_LINES}
    assert not too_long, f"files have fewer than {MAX_LINES} lines: split these, or name them in LONGER with the reason"


def parameters_of(thing: object) -> list[str]:
    """The parameters of a function, or of the constructor that a class defines itself."""
    if inspect.isclass(thing):
        is_generated = dataclasses.is_dataclass(thing) or issubclass(thing, tuple)
        if not is_generated and "__init__" not in vars(thing):
            return []
    return [name for name in inspect.signature(thing).parameters if not name.startswith("_")]  # type: ignore[arg-type]


@pytest.mark.parametrize("module_name", PUBLIC)
def test_public_names_are_there_and_documented(module_name: str) -> None:
    module = importlib.import_module(module_name)
    assert module.__all__
    undocumented = []
    for name in module.__all__:
        thing = getattr(module, name)
        # Python 3.10 takes Callable[...] for a class
        if get_origin(thing) or not (inspect.isclass(thing) or inspect.isfunction(thing)):
            continue
        # A docstring that is only inherited does not describe this class
        text = vars(thing).get("__doc__") or "" if inspect.isclass(thing) else thing.__doc__ or ""
        missing = [parameter for parameter in parameters_of(thing) if f":param {parameter}:" not in text]
        if missing or not text:
            undocumented.append(f"{name}: {', '.join(missing) or 'no docstring'}")
    assert not undocumented, "\n".join(undocumented)


@pytest.mark.parametrize("table", ["BASELINES", "ESTIMATORS", "PERTURBATIONS"])
def test_every_named_function_is_in_the_docs_the_docstring_and_the_enumeration(table: str) -> None:
    """What else is due when one is added; CONTRIBUTING.md lists the rest."""
    page = "rollouts.md" if table == "BASELINES" else "finite_difference.md"
    text = (Path(__file__).parents[1] / "docs" / page).read_text(encoding="utf-8")
    algorithm = sb3_reinforce.REINFORCE if table == "BASELINES" else sb3_reinforce.FiniteDifference
    names = getattr(importlib.import_module("sb3_reinforce.estimation"), table)
    missing = [name for name in names if f'`"{name}"`' not in text or f'``"{name}"``' not in str(algorithm.__doc__)]
    if table == "BASELINES":
        enumeration = (Path(__file__).parent / "estimation" / "test_enumeration.py").read_text(encoding="utf-8")
        missing += [name for name in names if f'"{name}"' not in enumeration]
    assert not missing
