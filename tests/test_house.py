"""House rules that a machine can check."""

import ast
import collections
import functools
import graphlib
import importlib
import importlib.util
import pkgutil
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
STAGES = ("capture", "preprocess", "avatar", "export", "instant_avatar")
"""Production packages, in the order of the data flow; imports point the other way."""
MAX_MODULE_LINES = 600
MAX_FUNCTION_LINES = 60
MAX_ARGUMENTS = 10
MAX_KERNEL_LINES = 100
"""Limits of a module, and of a function: a compiled kernel is one long loop over plain arrays."""
MAX_MODULES = 14
"""Modules in a folder, without `__init__`."""
MIN_DOCUMENTED = 0.97
"""Fraction of public classes, functions and methods with a docstring."""
UNCLEAR_WORDS = re.compile(
    r"\b(manieth|against the clock|ever again|so many|so much|nobody|somebody|whoever|is said"
    r"|is told|are told|is asked|anew|with which|likewise|\w*colour\w*)\b",
    re.IGNORECASE,
)
"""Words of an earlier dialect, also within names: state the quantity, or the actor, instead."""
QUOTED = ("CHANGELOG.md", "dev/lab-log.md", "dev/log/", "tests/test_house.py")
"""Files and folders that may hold them: history, and this list."""
RULED = ast.Import | ast.ImportFrom | ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef
"""What the rules are about."""


@functools.cache
def sources():
    """Every Python file of the stages, with its syntax tree."""
    return [
        (path.relative_to(ROOT), ast.parse(path.read_text(encoding="utf-8")))
        for stage in STAGES
        for path in sorted((ROOT / stage).rglob("*.py"))
    ]


@functools.cache
def nodes():
    """Imports, functions and classes by file, wherever in the file they are."""
    return {path: [n for n in ast.walk(tree) if isinstance(n, RULED)] for path, tree in sources()}


def modules(package):
    """A package and everything below it, by name."""
    below = pkgutil.walk_packages([str(ROOT / package.replace(".", "/"))], package + ".")
    return [package, *(found.name for found in below)]


def loads(names, forbidden):
    """What of the forbidden has been loaded in a fresh interpreter that imports the names."""
    code = (
        f"import importlib, sys\nfor name in {names!r}: importlib.import_module(name)\n"
        f"print(*(name for name in {forbidden!r} if name in sys.modules))"
    )
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout.split()


# --- imports ----------------------------------------------------------------------------------


def imported(node):
    """What a statement imports: modules, and what may be one."""
    names = [alias.name for alias in node.names]
    if isinstance(node, ast.Import):
        return names
    return [node.module, *(f"{node.module}.{name}" for name in names)]


def circle(files):
    """Files that import one another in a circle, wherever in them they do; none if there is none.

    Args:
        files: Nodes by module name. What a package's `__init__` passes on does not count.
    """
    graph = {}
    for name, found in files.items():
        imports = (node for node in found if isinstance(node, ast.Import | ast.ImportFrom))
        graph[name] = {each for node in imports for each in imported(node)} & files.keys() - {name}
    try:
        graphlib.TopologicalSorter(graph).prepare()
    except graphlib.CycleError as error:
        return error.args[1]
    return []


def test_no_two_files_lean_on_one_another():
    files = {
        ".".join(path.with_suffix("").parts): found
        for path, found in nodes().items()
        if path.name != "__init__.py"
    }
    assert circle(files) == []


def test_the_check_of_circles_can_fail():
    texts = {"a.x": "from a import y", "a.y": "def f():\n import a.z", "a.z": "import a.x"}
    files = {name: list(ast.walk(ast.parse(text))) for name, text in texts.items()}
    assert set(circle(files)) == set(files)
    assert circle({**files, "a.z": ast.parse("import numpy").body}) == []


def test_what_stands_before_or_after_training_loads_without_torch():
    names = [*modules("capture"), *modules("preprocess"), "export.player"]
    assert loads(names, ("torch",)) == []


@pytest.mark.slow
def test_the_checks_of_what_is_loaded_can_fail():
    assert loads(["avatar.rig", "capture.video"], ("scipy", "cv2", "onnx")) == ["scipy", "cv2"]
    assert loads(["avatar.radiance_field"], ("torch",)) == ["torch"]


@pytest.mark.parametrize("stage", STAGES)
def test_every_module_can_be_imported_and_comes_from_this_checkout(stage):
    for name in modules(stage):
        module = importlib.import_module(name)
        assert module.__doc__, f"{name} has no docstring"
        assert Path(module.__file__).is_relative_to(ROOT / stage)


def test_the_stages_are_all_the_packages_there_are():
    found = {path.parent.name for path in ROOT.glob("*/__init__.py")}
    assert found == {*STAGES, "baselines", "benchmarks"}
    assert not list((ROOT / "tests").rglob("__init__.py"))  # it would hide the real packages


# --- size -------------------------------------------------------------------------------------


def functions():
    """Every function of the stages: its file, name, syntax tree, and whether numba compiles it."""
    for path, found in nodes().items():
        for node in found:
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                decorators = " ".join(map(ast.unparse, node.decorator_list))
                kernel = "compile_kernel" in decorators or "kernels" in path.parts[1]
                yield path, node, kernel


def test_a_module_holds_one_idea():
    lines = {
        str(path): len((ROOT / path).read_text(encoding="utf-8").splitlines())
        for path, _ in sources()
    }
    too_long = {path: count for path, count in lines.items() if count > MAX_MODULE_LINES}
    assert not too_long, f"over {MAX_MODULE_LINES} lines: {too_long}"


def test_a_function_fits_a_screen():
    too_long = {
        f"{path}:{node.name}": lines
        for path, node, kernel in functions()
        if (lines := node.end_lineno - node.lineno + 1)
        > (MAX_KERNEL_LINES if kernel else MAX_FUNCTION_LINES)
    }
    assert not too_long, f"over {MAX_FUNCTION_LINES} lines (40 are the aim): {too_long}"


def test_a_signature_can_be_remembered():
    wide = {}
    for path, node, kernel in functions():
        names = [a.arg for a in (*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs)]
        count = len([name for name in names if name not in ("self", "cls")])
        if count > MAX_ARGUMENTS and not kernel:
            wide[f"{path}:{node.name}"] = count
    assert not wide, f"over {MAX_ARGUMENTS} arguments: {wide}"


def test_a_folder_can_be_surveyed():
    counts = collections.Counter(
        path.parent.as_posix() for path, _ in sources() if path.name != "__init__.py"
    )
    assert {folder: n for folder, n in counts.items() if n > MAX_MODULES} == {}
    assert [folder for folder in counts if folder.count("/") > 1] == []


# --- names and words --------------------------------------------------------------------------


def twice(names):
    """Those of the names that are given more than once."""
    return sorted(name for name, count in collections.Counter(names).items() if count > 1)


def test_no_class_and_no_module_is_called_like_another():
    assert twice(path.stem for path in nodes() if path.name != "__init__.py") == []
    found = (node for each in nodes().values() for node in each)
    assert twice(node.name for node in found if isinstance(node, ast.ClassDef)) == []


def test_what_is_public_is_documented():
    known = []
    for path, tree in sources():
        owners = [tree, *(n for n in nodes()[path] if isinstance(n, ast.ClassDef))]
        for owner in owners:
            known.extend(
                (f"{path}:{node.name}", ast.get_docstring(node) is not None)
                for node in owner.body
                if isinstance(node, ast.FunctionDef | ast.ClassDef) and node.name[0] != "_"
            )
    missing = [name for name, documented in known if not documented]
    assert 1.0 - len(missing) / len(known) >= MIN_DOCUMENTED, missing


@pytest.mark.parametrize(
    ("text", "count"),
    [("# So many rays", 1), ("test_a_note_is_said", 1), ("NO_COLOUR = 1", 1), ("ananew", 0)],
)
def test_the_check_of_words_can_fail(text, count):
    assert len(UNCLEAR_WORDS.findall(text.replace("_", " "))) == count


def test_the_words_are_those_of_the_field():
    unclear = [
        f"{name}:{number}: {found.group()}"
        for name, text in tracked_texts()
        if name.endswith((".py", ".md", ".js", ".css", ".html", ".toml"))
        and not name.startswith(QUOTED)
        for number, line in enumerate(text.splitlines(), start=1)
        for found in UNCLEAR_WORDS.finditer(line.replace("_", " "))
    ]
    assert not unclear, "\n".join(unclear)


def test_no_folder_of_leftovers():
    homeless = {"utils", "util", "common", "helpers", "helper", "misc", "types", "core"}
    assert [str(path) for path, _ in sources() if homeless & {path.stem, *path.parts}] == []


# --- what must not be published ---------------------------------------------------------------


def tracked_texts():
    """Every file that git keeps and that is text."""
    listed = subprocess.run(
        ["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=False
    )
    if listed.returncode:
        pytest.skip("this is no git checkout")
    for name in filter(None, listed.stdout.split("\0")):
        path = ROOT / name
        if not path.is_file():
            continue
        content = path.read_bytes()
        if b"\0" not in content:
            yield name, content.decode("utf-8", errors="replace")


def test_no_file_knows_the_machine_it_was_written_on():
    homes = ["/" + name + "/" for name in ("work", "farm", "root", "Users")]
    leaks = [(name, home) for name, text in tracked_texts() for home in homes if home in text]
    assert leaks == []
