"""The rules of the house, read from the syntax tree: what code may say and import.

`violations(source)` lists the forbidden constructs of one file as "line: rule";
`test_house.py` runs it over the package and shows that each rule bites.
"""

import ast
from collections.abc import Iterator

#: Imports point down; rooms of one layer do not see each other, but for SIBLINGS.
LAYERS: tuple[frozenset[str], ...] = (
    frozenset({"types", "errors", "checks", "cleanup", "compilation"}),
    frozenset({"inference"}),
    frozenset({"systems"}),
    frozenset({"belief", "data", "runs"}),
    frozenset({"models", "identification", "planning"}),
    frozenset({"project", "experiment_design", "robot", "reports"}),
    frozenset({"studies"}),
    frozenset({"commands"}),
    frozenset({"cli"}),
)
#: In the lowest layer modules build on each other; a belief is fitted to data.
SIBLINGS: frozenset[tuple[str, str]] = frozenset(
    {
        ("checks", "errors"),
        ("types", "errors"),
        ("types", "checks"),
        ("compilation", "types"),
        ("belief", "data"),
    }
)
#: Never loaded by importing sim2gp, so never imported at the top of a module.
HEAVY = frozenset(
    "matplotlib mujoco gymnasium h5py pyarrow rosbags mcap minari ray wandb mlflow "
    "tensorboardX blackjax imageio lxml pandas torch".split()
)
#: Run code that a file brings along (X1), or reach for the network (X5).
UNSAFE_MODULES = frozenset(
    "pickle _pickle cPickle cloudpickle dill joblib marshal shelve yaml "
    "urllib.request http.client requests httpx aiohttp ftplib telnetlib".split()
)
CATCH_ALL = frozenset({"Exception", "BaseException"})


def room_of(module: str) -> str:
    """`sim2gp.systems.plants.furuta` lives in the room `systems`."""
    return module.split(".")[1] if "." in module else ""


def layer_of(room: str) -> int:
    """The height of a room; ValueError for a room that design has not placed."""
    for height, rooms in enumerate(LAYERS):
        if room in rooms:
            return height
    raise ValueError(f"room {room!r} has no layer; place it in tests/house_rules.py")


def may_import(importer: str, imported: str) -> bool:
    """Whether one room may see another."""
    if importer == imported:
        return True
    below = layer_of(imported) < layer_of(importer)
    return below or (importer, imported) in SIBLINGS


def imported_modules(tree: ast.AST, module: str, is_package: bool) -> Iterator[str]:
    """Every absolute module name imported anywhere in a file (functions included).

    ``from a import b`` yields ``a.b``: b may be a module, and if it is not, the room
    is the same.
    """
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                parents = module.split(".")
                keep = len(parents) - node.level + (1 if is_package else 0)
                base = ".".join([*parents[:keep], *([base] if base else [])])
            yield from (f"{base}.{alias.name}" for alias in node.names)


def top_level_imports(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """(line, module) of imports that run when the file is imported."""
    pending: list[ast.AST] = list(tree.body)
    while pending:
        node = pending.pop()
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda):
            continue
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            pending.extend(node.orelse)
        elif isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            yield node.lineno, node.module
        else:
            pending.extend(ast.iter_child_nodes(node))


def violations(source: str, filename: str = "<source>") -> list[str]:
    """Forbidden constructs of one file, as "line: rule"."""
    tree = ast.parse(source, filename)
    found = [
        (line, f"top-level import of {name}")
        for line, name in top_level_imports(tree)
        if name.split(".")[0] in HEAVY
    ]
    for node in ast.walk(tree):
        found += [(getattr(node, "lineno", 0), rule) for rule in _rules_broken_by(node)]
    return [f"{line}: {rule}" for line, rule in sorted(found)]


def _rules_broken_by(node: ast.AST) -> Iterator[str]:
    match node:
        case ast.Import() | ast.ImportFrom():
            yield from _import_rules(node)
        case ast.Call():
            yield from _call_rules(node)
        case ast.ExceptHandler():
            if node.type is None:
                yield "bare except"
            elif _names(node.type) & CATCH_ALL and _does_nothing(node.body):
                yield "swallowed Exception"
        case ast.FunctionDef() | ast.AsyncFunctionDef() | ast.Lambda():
            if _has_default_key(node.args):
                yield "defaulted key"
        case ast.Attribute(attr="nan_to_num") | ast.Name(id="nan_to_num"):
            yield "nan_to_num"
        case ast.Attribute(attr="inv", value=owner) if _last_name(owner) == "linalg":
            yield "explicit inverse"


def _import_rules(node: ast.Import | ast.ImportFrom) -> Iterator[str]:
    base = node.module or "" if isinstance(node, ast.ImportFrom) else ""
    for alias in node.names:
        full = f"{base}.{alias.name}" if base else alias.name
        parts = full.split(".")
        prefixes = {".".join(parts[:end]) for end in range(1, len(parts) + 1)}
        if prefixes & UNSAFE_MODULES:
            yield f"import of {full}"
        if alias.name == "nan_to_num":
            yield "nan_to_num"
        if alias.name == "inv" and base.endswith("linalg"):
            yield "explicit inverse"


def _call_rules(node: ast.Call) -> Iterator[str]:
    name = _last_name(node.func)
    plain = isinstance(node.func, ast.Name)
    owner = _last_name(node.func.value) if isinstance(node.func, ast.Attribute) else ""
    if plain and name in {"eval", "exec", "__import__"}:
        yield f"{name}()"
    if (plain and name in {"exit", "quit"}) or (owner, name) == ("sys", "exit"):
        yield "exit()"
    if (owner, name) in {("os", "_exit"), ("os", "system"), ("os", "popen")}:
        yield f"os.{name}()"
    if name == "where" and node.args and _asks_isnan(node.args[0]):
        yield "where(isnan)"
    if name == "update" and node.args:
        first = node.args[0]
        if isinstance(first, ast.Constant) and first.value == "jax_enable_x64":
            yield "global float64"
    for keyword in node.keywords:
        truthy = isinstance(keyword.value, ast.Constant) and keyword.value.value is True
        if keyword.arg in {"shell", "allow_pickle"} and truthy:
            yield f"{keyword.arg}=True"


def _asks_isnan(node: ast.expr) -> bool:
    calls = (n for n in ast.walk(node) if isinstance(n, ast.Call))
    return any(_last_name(call.func) == "isnan" for call in calls)


def _last_name(node: ast.expr) -> str:
    if isinstance(node, ast.Attribute):
        return node.attr
    return node.id if isinstance(node, ast.Name) else ""


def _names(node: ast.expr) -> set[str]:
    return {_last_name(n) for n in ast.walk(node) if isinstance(n, ast.expr)}


def _does_nothing(body: list[ast.stmt]) -> bool:
    """Only pass, continue, a bare return or a constant: the error is gone."""
    return all(
        isinstance(s, ast.Pass | ast.Continue)
        or (isinstance(s, ast.Expr) and isinstance(s.value, ast.Constant))
        or (isinstance(s, ast.Return) and s.value is None)
        for s in body
    )


def _has_default_key(arguments: ast.arguments) -> bool:
    """A random key with a default; a TOML key (annotated as text) is another thing."""
    positional = arguments.posonlyargs + arguments.args
    defaults: list[tuple[ast.arg, ast.expr | None]] = [
        *zip(reversed(positional), reversed(arguments.defaults), strict=False),
        *zip(arguments.kwonlyargs, arguments.kw_defaults, strict=True),
    ]
    return any(
        default is not None
        and argument.arg == "key"
        and not (argument.annotation and "str" in ast.unparse(argument.annotation))
        for argument, default in defaults
    )
