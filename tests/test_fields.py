"""What a data class keeps is asked for: each of its fields has a reader in the program, by class and not by name."""

import ast
from dataclasses import dataclass, field
from pathlib import Path

from tests.test_architecture import ROOT, names_imported_by

ROOMS = ("formats", "pipelines", "msgs_cli", "msgs_slam", "tests/benchmarks")
READ_ELSEWHERE = {
    "evaluation.metrics.DepthError": "written to evaluation.json as a whole",
    "evaluation.metrics.SurfaceError": "written to evaluation.json as a whole",
    "evaluation.truth.ErrorStatistics": "written to evaluation.json as a whole",
    "types.Metres.by_source": "written to scale.json, for people",
    "types.MetresSource": "written to scale.json, for people",
}
"""Classes of pipelines/ or fields of theirs that have their reader outside of the program."""
Classes = frozenset[str]
"""Absolute names of classes that a value may be, or hold: of `dict[str, Frame] | None` that of `Frame`."""
NONE: Classes = frozenset()


@dataclass
class Known:
    """Data classes with their fields; annotations of fields, properties and results of methods by class and name;
    results of functions; base classes. All by absolute names."""

    fields: dict[str, set[str]] = field(default_factory=dict)
    members: dict[tuple[str, str], Classes] = field(default_factory=dict)
    results: dict[str, Classes] = field(default_factory=dict)
    values: dict[str, Classes] = field(default_factory=dict)
    bases: dict[str, Classes] = field(default_factory=dict)
    classes: set[str] = field(default_factory=set)

    def member(self, owner: str, name: str) -> Classes:
        """What a member is, looked for in the base classes too."""
        if (owner, name) in self.members:
            return self.members[owner, name]
        return frozenset().union(*(self.member(base, name) for base in self.bases.get(owner, NONE)))


@dataclass
class Module:
    """A file: its absolute name, its tree, and what the names in it mean."""

    name: str
    tree: ast.Module
    names: dict[str, str]

    @staticmethod
    def read(path: Path, text: str) -> "Module":
        name = ".".join(("msgs_slam", *path.relative_to(ROOT).with_suffix("").parts)).removesuffix(".__init__")
        tree = ast.parse(text)
        names = {n.name: f"{name}.{n.name}" for n in tree.body if isinstance(n, ast.ClassDef | ast.FunctionDef)}
        for node in ast.walk(tree):
            for full in names_imported_by(node, path):
                names[full.rpartition(".")[2]] = full
            for alias in node.names if isinstance(node, ast.ImportFrom | ast.Import) else ():
                if alias.asname and (full := names.get(alias.name.rpartition(".")[2])):
                    names[alias.asname] = full
        return Module(name, tree, names)

    def annotated(self, annotation: ast.expr | None, known: Known) -> Classes:
        """The program's classes that an annotation names."""
        if annotation is None:
            return NONE
        found = set()
        for node in ast.walk(annotation):
            if isinstance(node, ast.Constant) and str(node.value).isidentifier():
                found |= self.annotated(ast.Name(str(node.value)), known)
            elif isinstance(node, ast.Name) and (full := self.names.get(node.id)):
                found |= {full} if full in known.classes else known.values.get(full, NONE)
        return frozenset(found)


def is_data_class(node: ast.ClassDef) -> bool:
    return any("dataclass" in ast.unparse(decorator) for decorator in node.decorator_list)


def learn(modules: list[Module]) -> Known:
    """What the definitions say. Names that are imported through a package are followed to where they are defined."""
    known = Known()
    defined = set[str]()
    for module in modules:
        for node in module.tree.body:
            if isinstance(node, ast.ClassDef):
                known.classes.add(f"{module.name}.{node.name}")
            if isinstance(node, ast.ClassDef | ast.FunctionDef):
                defined.add(f"{module.name}.{node.name}")
            if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name):
                module.names.setdefault(node.targets[0].id, f"{module.name}.{node.targets[0].id}")
                defined.add(f"{module.name}.{node.targets[0].id}")
    own = {module.name: module for module in modules}
    for module in modules:
        for name, full in module.names.items():
            place, _, last = full.rpartition(".")
            while full not in defined and place in own and last in own[place].names and own[place].names[last] != full:
                full = own[place].names[last]
                place, _, last = full.rpartition(".")
            module.names[name] = full
    for module in modules:  # Source = VideoRecording | FolderRecording; PAPER = Constants()
        for node in module.tree.body:
            if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name):
                known.values[f"{module.name}.{node.targets[0].id}"] = module.annotated(node.value, known)
    for module in modules:
        for node in module.tree.body:
            if isinstance(node, ast.FunctionDef):
                known.results[f"{module.name}.{node.name}"] = module.annotated(node.returns, known)
            if isinstance(node, ast.ClassDef):
                learn_class(module, node, known)
    for module in modules * 2:  # again, for what others keep
        for node in module.tree.body:
            if isinstance(node, ast.ClassDef):
                learn_attributes(module, node, known)
    return known


def learn_class(module: Module, node: ast.ClassDef, known: Known) -> None:
    name = f"{module.name}.{node.name}"
    known.bases[name] = frozenset().union(*(module.annotated(base, known) for base in node.bases))
    for inner in node.body:
        if isinstance(inner, ast.AnnAssign) and isinstance(inner.target, ast.Name):
            known.members[name, inner.target.id] = module.annotated(inner.annotation, known)
            if is_data_class(node):
                known.fields.setdefault(name, set()).add(inner.target.id)
        elif isinstance(inner, ast.FunctionDef):
            known.members[name, inner.name] = module.annotated(inner.returns, known)


def learn_attributes(module: Module, node: ast.ClassDef, known: Known) -> None:
    """What methods keep on `self`."""
    name = f"{module.name}.{node.name}"
    for method in (n for n in node.body if isinstance(n, ast.FunctionDef)):
        reader = Reader(module, known, set(), name)
        reader.take_parameters(method)
        for statement in ast.walk(method):
            if isinstance(statement, ast.Assign | ast.AnnAssign) and statement.value is not None:
                targets = statement.targets if isinstance(statement, ast.Assign) else [statement.target]
                for target in (t for whole in targets for t in ast.walk(whole)):
                    if isinstance(target, ast.Name):
                        reader.bind(target, reader.classes_of(statement.value))
                    elif isinstance(target, ast.Attribute) and ast.unparse(target.value) == "self":
                        found = reader.classes_of(statement.value)
                        if isinstance(statement, ast.AnnAssign):
                            found |= module.annotated(statement.annotation, known)
                        known.members[name, target.attr] = known.members.get((name, target.attr), NONE) | found


class Reader(ast.NodeVisitor):
    """Notes which fields a file reads: (class, field)."""

    def __init__(self, module: Module, known: Known, read: set[tuple[str, str]], owner: str = "") -> None:
        self.module, self.known, self.read = module, known, read
        self.owner, self.names = owner, dict[str, Classes]()
        constants = (node.value for node in ast.walk(module.tree) if isinstance(node, ast.Constant))
        self.strings = {value for value in constants if isinstance(value, str)}

    def take_parameters(self, node: ast.FunctionDef | ast.Lambda) -> None:
        arguments = node.args
        for a in (*arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs, arguments.vararg, arguments.kwarg):
            if a is not None:
                self.names[a.arg] = self.module.annotated(a.annotation, self.known)
        first = [*arguments.posonlyargs, *arguments.args][:1]
        if self.owner and first and first[0].arg in ("self", "cls"):
            self.names[first[0].arg] = frozenset({self.owner})

    def classes_of(self, node: ast.expr) -> Classes:
        """What an expression may be or hold; too much rather than too little."""
        if isinstance(node, ast.Name):
            return self.names[node.id] if node.id in self.names else self.module.annotated(node, self.known)
        if isinstance(node, ast.Attribute):
            owners = self.classes_of(node.value)
            found = frozenset().union(*(self.known.member(owner, node.attr) for owner in owners))
            return found or (owners if node.attr in ("values", "items", "get", "pop", "copy") else NONE)
        if isinstance(node, ast.Call):
            if isinstance(node.func, ast.Name) and (full := self.module.names.get(node.func.id)):
                if full in self.known.classes:
                    return frozenset({full})
                if full in self.known.results:
                    return self.known.results[full]
            if isinstance(node.func, ast.Attribute) and isinstance(node.func.value, ast.Name):
                full = self.module.names.get(node.func.value.id, "")
                if full in self.known.classes:
                    return self.known.member(full, node.func.attr)
                if (result := self.known.results.get(f"{full}.{node.func.attr}")) is not None:
                    return result
            given = (self.classes_of(a) for a in (*node.args, *(k.value for k in node.keywords)))
            return self.classes_of(node.func) | frozenset().union(*given)
        if isinstance(node, ast.GeneratorExp | ast.ListComp | ast.SetComp | ast.DictComp):
            for comprehension in node.generators:
                self.bind(comprehension.target, self.classes_of(comprehension.iter))
            return self.classes_of(node.value if isinstance(node, ast.DictComp) else node.elt)
        if isinstance(node, ast.Lambda):
            return self.classes_of(node.body)
        if isinstance(node, ast.Constant | ast.JoinedStr | ast.Compare):
            return NONE
        parts = [n for n in ast.iter_child_nodes(node) if isinstance(n, ast.expr)]
        return frozenset().union(*(self.classes_of(n) for n in parts))

    def bind(self, target: ast.expr, found: Classes) -> None:
        for node in ast.walk(target):
            if isinstance(node, ast.Name):
                self.names[node.id] = self.names.get(node.id, NONE) | found

    def visit_ClassDef(self, node: ast.ClassDef) -> None:
        outer, self.owner = self.owner, self.module.names.get(node.name, "")
        self.generic_visit(node)
        self.owner = outer

    def visit_FunctionDef(self, node: ast.FunctionDef) -> None:
        outer = dict(self.names)
        self.take_parameters(node)
        for _ in range(2):  # a name may be used above where it is bound: loops
            self.generic_visit(node)
        self.names = outer

    def visit_Assign(self, node: ast.Assign) -> None:
        for target in node.targets:
            self.bind(target, self.classes_of(node.value)) if not isinstance(target, ast.Attribute) else None
        self.generic_visit(node)

    def visit_AnnAssign(self, node: ast.AnnAssign) -> None:
        if isinstance(node.target, ast.Name):
            self.bind(node.target, self.module.annotated(node.annotation, self.known))
        self.generic_visit(node)

    def visit_NamedExpr(self, node: ast.NamedExpr) -> None:
        self.bind(node.target, self.classes_of(node.value))
        self.generic_visit(node)

    def visit_For(self, node: ast.For) -> None:
        self.bind(node.target, self.classes_of(node.iter))
        self.generic_visit(node)

    def visit_With(self, node: ast.With) -> None:
        for item in node.items:
            if item.optional_vars is not None:
                self.bind(item.optional_vars, self.classes_of(item.context_expr))
        self.generic_visit(node)

    def visit_comprehension_of(self, node: ast.expr) -> None:
        self.classes_of(node)
        self.generic_visit(node)

    visit_GeneratorExp = visit_ListComp = visit_SetComp = visit_DictComp = visit_comprehension_of

    def visit_Call(self, node: ast.Call) -> None:
        called = node.func.id if isinstance(node.func, ast.Name) else ""
        if called == "getattr":  # of any of the names that stand in the file
            for name in self.strings:
                self.note(self.classes_of(node.args[0]), name)
        self.generic_visit(node)

    def visit_Attribute(self, node: ast.Attribute) -> None:
        if isinstance(node.ctx, ast.Load):
            self.note(self.classes_of(node.value), node.attr)
        self.generic_visit(node)

    def note(self, owners: Classes, name: str) -> None:
        places, waiting = set[str](), list(owners)
        while waiting:
            place = waiting.pop()
            places.add(place)
            waiting += self.known.bases.get(place, NONE)
        self.read |= {(place, name) for place in places}


def unread(sources: dict[Path, str]) -> set[str]:
    """Fields of data classes that no file reads, as `room.file.Class.field`."""
    modules = [Module.read(path, text) for path, text in sources.items()]
    known, read = learn(modules), set[tuple[str, str]]()
    for module in modules:
        Reader(module, known, read).visit(module.tree)
    derived: dict[str, set[str]] = {}
    for owner, bases in known.bases.items():
        for base in bases:
            derived.setdefault(base, set()).add(owner)
    return {
        f"{owner}.{name}".removeprefix("msgs_slam.").removeprefix("pipelines.")
        for owner, names in known.fields.items()
        for name in names
        if not owner.startswith("msgs_slam.tests.")  # benchmarks read, too
        and not {(place, name) for place in (owner, *derived.get(owner, ()))} & read
    }


def test_every_field_of_a_data_class_is_read() -> None:
    files = [p for room in ROOMS for p in (ROOT / room).rglob("*.py") if not any(q.is_symlink() for q in p.parents)]
    assert len(files) > 200
    found = unread({path: path.read_text(encoding="utf-8") for path in files})
    assert {name for name in found if not {name, name.rpartition(".")[0]} & READ_ELSEWHERE.keys()} == set()
    used = {key for key in READ_ELSEWHERE for name in found if key in (name, name.rpartition(".")[0])}
    assert used == READ_ELSEWHERE.keys(), "these have a reader"


READ = """
from dataclasses import dataclass

@dataclass
class Room:
    metric: bool
    width: float

@dataclass
class Walk:
    metric: bool
    rooms: list[Room]

def widths(walk: Walk) -> float:
    return sum(room.width for room in walk.rooms) if walk.metric else 0.0
"""


def test_a_field_hides_behind_no_other_of_its_name() -> None:
    assert unread({ROOT / "pipelines" / "a.py": READ}) == {"a.Room.metric"}
    asked = READ.replace("if walk.metric", "if walk.rooms[0].metric")
    assert unread({ROOT / "pipelines" / "a.py": asked}) == {"a.Walk.metric"}
    other = "from .a import Walk\n\ndef f(w: dict[str, Walk]):\n    [r.metric for x in w.values() for r in x.rooms]"
    assert unread({ROOT / "pipelines" / "a.py": READ, ROOT / "pipelines" / "b.py": other}) == set()
