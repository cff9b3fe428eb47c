"""Small faults, one at a time, where the answer and the rulers come from: do the tests see them?

Draws a seeded sample of faults (a comparison, an operator, a sign, a number, a condition, a
returned value, a statement left out), puts each into a copy of the repository, runs the tests of
its room there and says which faults none of them saw:

    python benchmarks/mutate.py --sample 300 --seed 1 --workers 2 --to mutants.json

By hand or at night, not in CI: a fault takes ten seconds or so.
"""

from __future__ import annotations

import argparse
import ast
import json
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from queue import Queue

ROOT = Path(__file__).parents[1]

_QUICK = "not (slow or process or browser or vulkan)"

ROOMS: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "matching": (
        ("stages/matching/*.py",),
        (f"matching and {_QUICK}", "figures or (matching and slow)"),
    ),
    "edges": (("stages/edges/*.py",), (f"edges and {_QUICK}", "figures or (edges and slow)")),
    "sensor": (("stages/dfd/*.py",), (f"sensor and {_QUICK}", "figures or (sensor and slow)")),
    "running": (
        tuple(f"workbench/{name}.py" for name in
              ("pipeline", "digest", "session", "settings", "report")),
        (f"pipeline and {_QUICK}", f"(cli or sweep or why) and {_QUICK}"),
    ),
    "comparing": (
        ("workbench/comparison.py", "workbench/differences.py"),
        (f"why and {_QUICK}", "why and not browser"),
    ),
    "sweep": (("workbench/sweep/*.py",), (f"sweep and {_QUICK}", "sweep and not browser")),
}  # fmt: skip
"""Room: the files in which faults are put, and which tests look at them (markers, see
``tests/rooms.py``), the quick ones first."""

_SECONDS = 600
"""After which tests are ended, and the fault counts as seen: most likely a loop has no end."""
_COMPARISONS = {
    ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq, ast.Is: ast.IsNot, ast.IsNot: ast.Is, ast.In: ast.NotIn, ast.NotIn: ast.In,
}  # fmt: skip
_OPERATORS = {
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult,
    ast.FloorDiv: ast.Mult, ast.Mod: ast.Mult, ast.BitAnd: ast.BitOr, ast.BitOr: ast.BitAnd,
    ast.And: ast.Or, ast.Or: ast.And, ast.Pow: ast.Mult, ast.LShift: ast.RShift,
    ast.RShift: ast.LShift, ast.BitXor: ast.BitOr, ast.MatMult: ast.MatMult,
}  # fmt: skip


@dataclass(frozen=True)
class Fault:
    """One small change of one file: bytes ``start`` to ``stop`` become ``text``."""

    file: str
    line: int
    start: int
    stop: int
    text: str
    kind: str
    before: str


class _Finder(ast.NodeVisitor):
    """All faults of a file.  What is said in words, and what types are, is left alone."""

    def __init__(self, file: str, source: bytes) -> None:
        self.file, self.source = file, source
        self._starts = [0]
        for line in source.splitlines(keepends=True):
            self._starts.append(self._starts[-1] + len(line))
        self.faults: list[Fault] = []

    def _add(self, node: ast.expr | ast.stmt, new: ast.AST | str, kind: str) -> None:
        assert node.end_lineno is not None and node.end_col_offset is not None
        start = self._starts[node.lineno - 1] + node.col_offset
        stop = self._starts[node.end_lineno - 1] + node.end_col_offset
        text = new if isinstance(new, str) else ast.unparse(new)
        if isinstance(node, ast.expr):
            text = f"({text})"
        before = " ".join(self.source[start:stop].decode().split())
        self.faults.append(Fault(self.file, node.lineno, start, stop, text, kind, before[:160]))

    def visit_Compare(self, node: ast.Compare) -> None:
        swapped = _COMPARISONS[type(node.ops[0])]()
        new = ast.Compare(node.left, [swapped, *node.ops[1:]], node.comparators)
        self._add(node, new, "comparison")
        self.generic_visit(node)

    def visit_BinOp(self, node: ast.BinOp) -> None:
        swapped = _OPERATORS[type(node.op)]()
        words = isinstance(node.left, ast.Constant) and isinstance(node.left.value, str)
        if type(swapped) is not type(node.op) and not words and not _is_type(node):
            self._add(node, ast.BinOp(node.left, swapped, node.right), "operator")
        self.generic_visit(node)

    def visit_BoolOp(self, node: ast.BoolOp) -> None:
        self._add(node, ast.BoolOp(_OPERATORS[type(node.op)](), node.values), "operator")
        self.generic_visit(node)

    def visit_UnaryOp(self, node: ast.UnaryOp) -> None:
        if isinstance(node.op, ast.USub | ast.Not | ast.Invert):
            self._add(node, node.operand, "sign")
        self.generic_visit(node)

    def visit_Constant(self, node: ast.Constant) -> None:
        value = node.value
        if isinstance(value, bool):
            self._add(node, repr(not value), "number")
        elif isinstance(value, int):
            self._add(node, repr(value + 1), "number")
        elif isinstance(value, float):
            self._add(node, repr(value * 1.5 if value else 1.0), "number")

    def visit_If(self, node: ast.If) -> None:
        if ast.unparse(node.test) != "TYPE_CHECKING":
            self._add(node.test, ast.UnaryOp(ast.Not(), node.test), "condition")
            self.generic_visit(node)

    def visit_IfExp(self, node: ast.IfExp) -> None:
        self._add(node.test, ast.UnaryOp(ast.Not(), node.test), "condition")
        self.generic_visit(node)

    def visit_While(self, node: ast.While) -> None:
        self.generic_visit(node)

    def visit_Return(self, node: ast.Return) -> None:
        if node.value is not None and not isinstance(node.value, ast.Constant):
            self._add(node, "return None", "returned value")
        self.generic_visit(node)

    def visit_AugAssign(self, node: ast.AugAssign) -> None:
        swapped = _OPERATORS[type(node.op)]()
        self._add(node, ast.AugAssign(node.target, swapped, node.value), "operator")
        self.generic_visit(node)

    def visit_Expr(self, node: ast.Expr) -> None:
        if isinstance(node.value, ast.Constant):
            return
        if isinstance(node.value, ast.Call):
            self._add(node, "pass", "statement left out")
        self.generic_visit(node)

    def visit_Continue(self, node: ast.Continue) -> None:
        self._add(node, "break", "statement")

    def visit_Break(self, node: ast.Break) -> None:
        self._add(node, "continue", "statement")

    def visit_FunctionDef(self, node: ast.FunctionDef) -> None:
        for default in (*node.args.defaults, *node.args.kw_defaults):
            if default is not None:
                self.visit(default)
        for statement in node.body:
            self.visit(statement)

    def visit_AnnAssign(self, node: ast.AnnAssign) -> None:
        if node.value is not None:
            self.visit(node.value)

    def visit_Raise(self, node: ast.Raise) -> None:
        """That it is raised is held by the condition above it; its words are words."""

    def visit_Assert(self, node: ast.Assert) -> None:
        """An assertion is a test of its own."""

    def visit_JoinedStr(self, node: ast.JoinedStr) -> None:
        """Words."""

    def visit_Import(self, node: ast.Import) -> None:
        """A file that cannot be imported is no test of the tests."""

    visit_ImportFrom = visit_Import


def _is_type(node: ast.BinOp) -> bool:
    """Whether ``a | b`` unites types: names that begin with a capital, or None."""
    if not isinstance(node.op, ast.BitOr):
        return False
    texts = (ast.unparse(node.left), ast.unparse(node.right))
    return any(
        text == "None" or text.rpartition(".")[2][:1].isupper() or text in ("int", "float", "str")
        for text in texts
    )


def faults_of(file: Path, root: Path = ROOT) -> list[Fault]:
    """Every fault that can be put into a file."""
    source = file.read_bytes()
    finder = _Finder(str(file.relative_to(root)), source)
    finder.visit(ast.parse(source))
    return finder.faults


def files_of(patterns: Sequence[str], root: Path = ROOT) -> Iterator[Path]:
    for pattern in patterns:
        yield from sorted(root.glob(pattern))


class Copy:
    """A copy of the work tree in which faults are tried; its packages come before the installed.

    What numba has compiled comes with it, for the files keep their times.
    """

    def __init__(self, folder: Path) -> None:
        self.root = folder / "repository"
        left = shutil.ignore_patterns(".git", ".venv", ".*_cache", "build", "*.egg-info")
        shutil.copytree(ROOT, self.root, ignore=left)
        self._site = folder / "site"
        self._site.mkdir()
        for name, target in (
            ("workbench", "workbench"),
            ("workbench_stages", "stages"),
            ("workbench_recordings", "recordings"),
        ):
            (self._site / name).symlink_to(self.root / target)
        self._importers = _importers(self.root)

    def test(self, tests: str, seconds: float | None = None) -> bool:
        """Whether the tests that a marker expression selects pass, within ``seconds``."""
        environment = os.environ | {"PYTHONPATH": str(self._site), "PYTHONDONTWRITEBYTECODE": "1"}
        for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"):
            environment[name] = "1"
        command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider"]
        try:
            ended = subprocess.run(
                [*command, "-m", tests],
                cwd=self.root,
                env=environment,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                timeout=seconds,
                start_new_session=True,
            )
        except subprocess.TimeoutExpired:
            return False
        return ended.returncode == 0

    def survives(self, fault: Fault, tests: Sequence[str]) -> bool:
        """Whether the tests pass with the fault."""
        path = self.root / fault.file
        source, stamp = path.read_bytes(), path.stat()
        kept = self._without_compiled(path)
        try:
            path.write_bytes(source[: fault.start] + fault.text.encode() + source[fault.stop :])
            try:
                compile(path.read_bytes(), str(path), "exec")
            except SyntaxError:
                return False
            return all(self.test(selection, _SECONDS) for selection in tests)
        finally:
            path.write_bytes(source)
            os.utime(path, ns=(stamp.st_atime_ns, stamp.st_mtime_ns))
            self._without_compiled(path)
            for file, data, times in kept:
                file.write_bytes(data)
                os.utime(file, ns=times)

    def _without_compiled(self, path: Path) -> list[tuple[Path, bytes, tuple[int, int]]]:
        """Remove what numba kept of a file and of those that import it; returns what was there.

        Numba looks only at the file that defines a function, not at those that it calls.
        """
        taken = []
        for file in self._importers.get(path, {path}) | {path}:
            for kept in (file.parent / "__pycache__").glob(f"{file.stem}.*.nb[ic]"):
                times = kept.stat()
                taken.append((kept, kept.read_bytes(), (times.st_atime_ns, times.st_mtime_ns)))
                kept.unlink()
        return taken


def _importers(root: Path) -> dict[Path, set[Path]]:
    """Each file of ``stages`` and those that import it, directly or through others."""
    direct: dict[Path, set[Path]] = {}
    for file in (root / "stages").rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_bytes())):
            if isinstance(node, ast.ImportFrom) and node.level:
                base = file.parents[node.level - 1]
                named = base.joinpath(*(node.module or "").split("."))
                for target in (named, *(named / alias.name for alias in node.names)):
                    direct.setdefault(target.with_suffix(".py"), set()).add(file)
    reached: dict[Path, set[Path]] = {}
    for file in direct:
        found, waiting = set[Path](), [file]
        while waiting:
            for importer in direct.get(waiting.pop(), set()) - found:
                found.add(importer)
                waiting.append(importer)
        reached[file] = found
    return reached


def drawn(rooms: Sequence[str], sample: int, seed: int) -> list[tuple[str, Fault]]:
    """A sample of the rooms' faults, as many from each as it has of all."""
    every = [
        (room, fault)
        for room in rooms
        for file in files_of(ROOMS[room][0])
        for fault in faults_of(file)
    ]
    chosen = random.Random(seed).sample(range(len(every)), min(sample, len(every)))
    return [every[index] for index in sorted(chosen)]


def survivors(file: Path) -> list[tuple[str, Fault]]:
    """What survived an earlier run, where it stands now."""
    found = []
    for fate in json.loads(file.read_text(encoding="utf-8")):
        known = (fate["kind"], fate["before"], fate["text"])
        faults = faults_of(ROOT / fate["file"])
        alike = [one for one in faults if (one.kind, one.before, one.text) == known]
        if fate["survived"] and alike:
            nearest = min(alike, key=lambda fault: abs(fault.line - fate["line"]))
            found.append((fate["room"], nearest))
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--sample", type=int, default=300)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--room", action="append", choices=sorted(ROOMS))
    parser.add_argument("--to", type=Path, help="Write every fault and its fate to this file.")
    parser.add_argument(
        "--again", type=Path, help="Only what survived in this file of an earlier run."
    )
    parser.add_argument("--count", action="store_true", help="Only say how many faults there are.")
    arguments = parser.parse_args()
    rooms = arguments.room or list(ROOMS)
    if arguments.count:
        for room in rooms:
            faults = [f for file in files_of(ROOMS[room][0]) for f in faults_of(file)]
            print(f"{room}: {len(faults)} faults in {len({f.file for f in faults})} files")
        return
    if arguments.again is not None:
        faults = survivors(arguments.again)
        rooms = sorted({room for room, _ in faults})
    else:
        faults = drawn(rooms, arguments.sample, arguments.seed)
    fates: list[dict[str, object]] = []
    with tempfile.TemporaryDirectory(prefix="mutate-") as name:
        copies: Queue[Copy] = Queue()
        for worker in range(arguments.workers):
            folder = Path(name) / str(worker)
            folder.mkdir()
            copies.put(Copy(folder))

        def sound(room: str) -> bool:
            copy = copies.get()
            try:
                return all(copy.test(selection) for selection in ROOMS[room][1])
            finally:
                copies.put(copy)

        def tried(drawn: tuple[str, Fault]) -> tuple[str, Fault, bool, float]:
            room, fault = drawn
            copy, begun = copies.get(), time.monotonic()
            try:
                return room, fault, copy.survives(fault, ROOMS[room][1]), time.monotonic() - begun
            finally:
                copies.put(copy)

        with ThreadPoolExecutor(arguments.workers) as pool:
            for room, passes in zip(rooms, pool.map(sound, rooms), strict=True):
                if not passes:
                    sys.exit(f"{room}: its tests fail without a fault")
            for room, fault, survived, seconds in pool.map(tried, faults):
                fate = "SURVIVED" if survived else "killed"
                fates.append({"room": room, "survived": survived, **asdict(fault)})
                where = f"{fault.file}:{fault.line}"
                print(
                    f"{fate:8} {seconds:5.1f} s {where} {fault.kind}: {fault.before} → {fault.text}"
                )
                sys.stdout.flush()
                if arguments.to is not None:
                    arguments.to.write_text(json.dumps(fates, indent=1), encoding="utf-8")
    tally: dict[str, Counter[bool]] = {}
    for fate in fates:
        tally.setdefault(str(fate["room"]), Counter())[bool(fate["survived"])] += 1
    for room, counts in tally.items():
        print(f"{room}: {counts[False]} of {counts.total()} killed")
    killed = sum(counts[False] for counts in tally.values())
    print(f"{killed} of {len(fates)} killed: {100 * killed / max(len(fates), 1):.1f} %")


if __name__ == "__main__":
    main()
