"""The house in numbers: how large it is, how many names it has, where it turns in circles.

    python -m tests.house_figures [ROOT]               # this checkout, or another
    python -m tests.house_figures --list "twin names"  # what one figure counts

Product means the `*.py` files of the four packages, without tests, docs and setup.py. The function of a
figure returns what it counts (files, functions, groups of modules), each item with its size.
"""

import argparse
import ast
import re
from collections import Counter
from collections.abc import Callable, Collection
from pathlib import Path, PurePosixPath
from typing import NamedTuple

import networkx as nx

PACKAGES = ("ratslam", "robot", "evaluation", "tactile")
Function = ast.FunctionDef | ast.AsyncFunctionDef
Definition = Function | ast.ClassDef
Items = dict[str, int]


class Source(NamedTuple):
    """A product file: its path from the root, its module, its text and all nodes of its syntax tree."""

    path: PurePosixPath
    module: str
    text: str
    nodes: list[ast.AST]

    def place(self, node: Definition) -> str:
        return f"{self.path}:{node.lineno} {node.name}"


class House(NamedTuple):
    """A checkout: its product files, definitions by place, and pairs (importing, imported module)."""

    root: Path
    sources: list[Source]
    definitions: dict[str, Definition]
    arrows: set[tuple[str, str]]


def read_house(root: Path) -> House:
    sources = []
    for path in (path for package in PACKAGES for path in sorted((root / package).rglob("*.py"))):
        text = path.read_text(encoding="utf-8")
        inside = PurePosixPath(path.relative_to(root).as_posix())
        module = ".".join(inside.with_suffix("").parts).removesuffix(".__init__")
        sources.append(Source(inside, module, text, list(ast.walk(ast.parse(text)))))
    definitions = {s.place(node): node for s in sources for node in s.nodes if isinstance(node, Definition)}
    return House(root, sources, definitions, _arrows(sources))


def _arrows(sources: list[Source]) -> set[tuple[str, str]]:
    """All imports, also in functions and for types; `from a import b` is of a.b, or of a if b is a name."""
    modules = {source.module for source in sources}
    arrows = set[tuple[str, str]]()
    for source in sources:
        for node in (node for node in source.nodes if isinstance(node, ast.Import | ast.ImportFrom)):
            above = [*source.path.parts[: -getattr(node, "level", 0)], getattr(node, "module", "")]
            for name in (".".join(filter(None, [*above, alias.name])) for alias in node.names):
                target = name if name in modules else name.rpartition(".")[0]
                if target in modules and target != source.module:
                    arrows.add((source.module, target))
    return arrows


def rooms(house: House) -> Items:
    """Folders directly in a package that have a *.py file in them or below them."""
    return dict(Counter("/".join(s.path.parts[:2]) for s in house.sources if len(s.path.parts) > 2))


def folders(house: House) -> Items:
    """Folders at any depth, the packages included, that have a *.py file directly in them."""
    return dict(Counter(str(source.path.parent) for source in house.sources))


def product_lines(house: House) -> Items:
    """Lines of the product files, `__init__.py`, blank lines and comments included."""
    return {str(source.path): source.text.count("\n") for source in house.sources}


def code_lines(house: House) -> Items:
    """Product lines that are not blank, not only a comment and not part of a docstring."""
    counted = {}
    for source in house.sources:
        lines = enumerate(map(str.strip, source.text.split("\n")), start=1)
        code = {number for number, line in lines if line and not line.startswith("#")}
        for node in source.nodes:
            if isinstance(node, ast.Module | ast.ClassDef | Function) and ast.get_docstring(node) is not None:
                code -= set(range(node.body[0].lineno, (node.body[0].end_lineno or 0) + 1))
        counted[str(source.path)] = len(code)
    return counted


def lines_of_tests(house: House) -> Items:
    """Lines of all *.py files under tests, blank lines and comments included."""
    paths = sorted((house.root / "tests").rglob("*.py"))
    return {str(p.relative_to(house.root)): p.read_text(encoding="utf-8").count("\n") for p in paths}


def function_lines(house: House) -> Items:
    """Lines of each function and method from its `def` to its end."""
    functions = {place: node for place, node in house.definitions.items() if isinstance(node, Function)}
    return {place: (node.end_lineno or 0) - node.lineno + 1 for place, node in functions.items()}


def all_names(house: House) -> Items:
    """Functions (async ones too) and classes at the top level of a module."""
    return {place: 1 for place, node in house.definitions.items() if node.col_offset == 0}


def public_names(house: House) -> Items:
    """Functions and classes at the top level of a module whose name has no leading underscore."""
    return {place: 1 for place in all_names(house) if " _" not in place}


def records(house: House) -> Items:
    """Classes that are a NamedTuple, a TypedDict or a dataclass."""
    mark = re.compile(r"\b(NamedTuple|TypedDict|dataclass)\b")
    classes = {place: node for place, node in house.definitions.items() if isinstance(node, ast.ClassDef)}
    above = {place: [*node.bases, *node.decorator_list] for place, node in classes.items()}
    return {place: 1 for place, nodes in above.items() if any(mark.search(ast.unparse(n)) for n in nodes)}


def named_privately(house: House) -> Items:
    """Functions and classes with one leading underscore; the size: how often the file's code names them."""
    every = {str(source.path): source.nodes for source in house.sources}
    names = {path: Counter(getattr(n, "id", getattr(n, "attr", "")) for n in every[path]) for path in every}
    found = {place: node.name for place, node in house.definitions.items() if re.match("_[^_]", node.name)}
    return {place: names[place.split(":")[0]][name] for place, name in found.items()}


def unused_private_names(house: House) -> Items:
    """Private functions and classes at the top level that the code of their file never names."""
    named = named_privately(house)
    return {place: 1 for place in all_names(house) if named.get(place) == 0}


def short_and_called_once(house: House) -> Items:
    """Private functions of at most 8 lines, decorators included, that the code of their file names once."""
    once = {place: house.definitions[place] for place, n in named_privately(house).items() if n == 1}
    functions = {place: node for place, node in once.items() if isinstance(node, Function)}
    first = {p: min(n.lineno for n in [f, *f.decorator_list]) for p, f in functions.items()}
    lines = {place: (f.end_lineno or 0) + 1 - first[place] for place, f in functions.items()}
    return {place: number for place, number in lines.items() if number <= 8}


def twin_names(house: House) -> Items:
    """File names in two or more folders that are not all siblings; `__init__` and `__main__` are free."""
    paths = [source.path for source in house.sources if not source.path.stem.startswith("__")]
    where = {stem: [p.parent for p in paths if p.stem == stem] for stem in {p.stem for p in paths}}
    twins = {stem: found for stem, found in where.items() if len({folder.parent for folder in found}) > 1}
    return {f"{stem}: {', '.join(map(str, found))}": len(found) for stem, found in twins.items()}


def module_circles(house: House) -> Items:
    """Groups of modules that import each other in a circle; the `__init__` above an import is not in it."""
    return _circles(house, depth=99)


def room_circles(house: House) -> Items:
    """Groups of rooms that import each other in a circle; a file directly in a package is a room here."""
    return _circles(house, depth=2)


def _circles(house: House, depth: int) -> Items:
    """Strongly connected groups of two or more modules, their names cut to `depth` parts, and their sizes."""
    cut = {source.module: ".".join(source.module.split(".")[:depth]) for source in house.sources}
    graph = nx.DiGraph([(cut[importer], cut[imported]) for importer, imported in house.arrows])
    groups = nx.strongly_connected_components(graph)
    return {" <-> ".join(sorted(group)): len(group) for group in groups if len(group) > 1}


class Figure(NamedTuple):
    """What is counted, how the sizes of the items make one number, and the largest that the house allows."""

    items: Callable[[House], Items]
    number: Callable[[Collection[int]], int] = len
    goal: int | None = None


FIGURES = {
    "rooms": Figure(rooms, goal=33),
    "folders": Figure(folders, goal=50),
    "files": Figure(product_lines, goal=480),
    "product lines": Figure(product_lines, sum, goal=74_000),
    "code lines": Figure(code_lines, sum, goal=49_000),
    "test lines": Figure(lines_of_tests, sum),
    "largest file": Figure(product_lines, max, 600),
    "longest function": Figure(function_lines, max, 80),
    "public names": Figure(public_names, goal=1900),
    "all names": Figure(all_names, goal=3100),
    "records": Figure(records, goal=350),
    "short and called once": Figure(short_and_called_once, goal=60),
    "unused private names": Figure(unused_private_names, goal=0),
    "twin names": Figure(twin_names, goal=0),
    "module circles": Figure(module_circles, goal=0),
    "room circles": Figure(room_circles, goal=0),
}


def count(root: Path) -> dict[str, int]:
    house = read_house(root)
    return {name: figure.number(figure.items(house).values()) for name, figure in FIGURES.items()}


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.house_figures")
    parser.add_argument("root", nargs="?", type=Path, default=Path(__file__).parents[1], metavar="ROOT")
    parser.add_argument("--list", choices=FIGURES, metavar="FIGURE", help="what it counts, largest first")
    arguments = parser.parse_args()
    if arguments.list:
        items = FIGURES[arguments.list].items
        listed = sorted(items(read_house(arguments.root)).items(), key=lambda item: (-item[1], item[0]))
        print(items.__doc__, *(f"{size:7,}  {item}" for item, size in listed), sep="\n")
        return
    print(f"{'figure':24}{'number':>10}{'at most':>10}")
    for name, number in count(arguments.root).items():
        goal = FIGURES[name].goal
        print(f"{name:24}{number:10,}{'' if goal is None else goal:>10}".rstrip())


if __name__ == "__main__":
    main()
