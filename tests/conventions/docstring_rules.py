"""Public names carry numpydoc docstrings that agree with their signatures."""

from __future__ import annotations

import ast
import inspect
import re
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

Function = ast.FunctionDef | ast.AsyncFunctionDef

_ARRAY = re.compile(r"\b(NDArray|ndarray|ArrayLike|\w*Array)\b")
_SHAPE = re.compile(r"\bshape|\(\s*[\w][\w .+*/-]*,[^()]*\)")
_AS = re.compile(r"As `(\w+)\.(\w+)`")
_NOT_FOR_CALLERS = {"NotImplementedError", "AssertionError"}


@dataclass(frozen=True)
class Docstring:
    """The sections of a numpydoc docstring, each a mapping from the names it documents to what it says of them."""

    summary: str
    sections: dict[str, dict[str, str]]
    texts: dict[str, str]

    @classmethod
    def read(cls, text: str) -> Docstring:
        lines = inspect.cleandoc(text).splitlines()
        starts = [i for i in range(len(lines) - 1) if lines[i].strip() and re.fullmatch(r"-{3,}", lines[i + 1].strip())]
        sections, texts = {}, {}
        for start, end in pairwise([*starts, len(lines)]):
            title, body = lines[start].strip(), lines[start + 2 : end]
            sections[title], texts[title] = _entries(body), "\n".join(body)
        summary = " ".join(lines[: starts[0]] if starts else lines).strip()
        return cls(summary=summary, sections=sections, texts=texts)

    def documented(self, *titles: str) -> dict[str, str]:
        return {name: text for title in titles for name, text in self.sections.get(title, {}).items()}


def _entries(body: list[str]) -> dict[str, str]:
    """Read ``a, b : type`` lines, each with the indented lines under it."""
    found: dict[str, str] = {}
    names: list[str] = []
    for line in body:
        if line[:1].strip():
            names = [name.strip().lstrip("*`").rstrip("`") for name in line.split(":")[0].split(",")]
            found.update(dict.fromkeys(names, line))
        else:
            found.update({name: f"{found[name]}\n{line}" for name in names})
    return found


def module_complaints(tree: ast.Module, only: set[str] | None = None) -> Iterator[str]:
    """Say what the docstrings of a module's public names lack; of `only` these names where given."""
    if only is None and not ast.get_docstring(tree):
        yield "line 1: the module has no docstring"
    for node in tree.body:
        wanted = only is None or getattr(node, "name", None) in only
        if isinstance(node, Function) and not node.name.startswith("_") and wanted:
            yield from _function_complaints(node, node.name)
        elif isinstance(node, ast.ClassDef) and not node.name.startswith("_") and wanted:
            yield from _class_complaints(node)


def _class_complaints(node: ast.ClassDef) -> Iterator[str]:
    text = ast.get_docstring(node)
    if not text:
        yield f"line {node.lineno}: class {node.name} has no docstring"
        return
    doc = Docstring.read(text)
    if _has_fields(node):
        attributes = doc.documented("Attributes", "Parameters")
        for name, annotation in _fields(node):
            yield from _entry_complaints(node.lineno, f"class {node.name}", "Attributes", name, annotation, attributes)
    described = doc.documented("Attributes")
    exception = any(ast.unparse(b).endswith(("Error", "Exception")) for b in node.bases)
    for member in node.body:
        if not isinstance(member, Function) or (_is_property(member) and member.name in described):
            continue
        if member.name == "__init__" and not exception:
            yield from _parameter_complaints(member, node.name, [doc, Docstring.read(ast.get_docstring(member) or "")])
        elif not member.name.startswith("_") and not promised_by(member, text):
            yield from _function_complaints(member, f"{node.name}.{member.name}", method=True)


def promised_by(method: Function, class_text: str) -> str:
    """Path of the contract whose docstring a method refers to, ``As `Device.start`.``; the class names it in full.

    Empty where the method refers to none, to another method, or to a contract that its class does not name.
    """
    found = _AS.match(ast.get_docstring(method) or "")
    if found is None or found[2] != method.name:
        return ""
    named = re.search(rf"`(ambid(?:\.\w+)*\.{found[1]})`", class_text)
    return named[1] if named else ""


def _function_complaints(node: Function, name: str, *, method: bool = False) -> Iterator[str]:
    if _decorators(node) & {"overload", "setter", "deleter"}:
        return
    where = f"line {node.lineno}: {name}"
    text = ast.get_docstring(node)
    if not text:
        yield f"{where} has no docstring"
        return
    if name == "command":  # a verb of the command line: its docstring is its help, and each option explains itself
        yield from _verb_complaints(node, where)
        return
    doc = Docstring.read(text)
    returned = ast.unparse(node.returns) if node.returns else "None"
    if _is_property(node) or (method and _one_sentence(node, doc)):
        if _ARRAY.search(returned) and not _SHAPE.search(text):
            yield f"{where} is an array; its docstring names no shape, e.g. (n_samples,)"
    else:
        if not doc.summary:
            yield f"{where} has no summary line above its sections"
        yield from _parameter_complaints(node, name, [doc])
        if returned not in ("None", "NoReturn", "Never"):
            yield from _return_complaints(where, returned, doc)
    yield from _raise_complaints(node, where, doc)


def _verb_complaints(node: Function, where: str) -> Iterator[str]:
    for argument in _arguments(node):
        annotation = ast.unparse(argument.annotation) if argument.annotation else ""
        shared = re.fullmatch(r"[A-Z]\w+( \| None)?", annotation)  # an option that several verbs share, explained once
        if "help=" not in annotation and not shared:
            yield f"{where}: option {argument.arg!r} has no help text"


def _one_sentence(node: Function, doc: Docstring) -> bool:
    """Tell whether a short method says all in one sentence: ``Return L in H at `x` in m``, each parameter named so."""
    arguments = [a for a in _arguments(node) if a.arg not in ("self", "cls")]
    return (
        not doc.sections.keys() & {"Parameters", "Returns"}
        and doc.summary.startswith(("Return ", "Yield "))
        and len(arguments) <= 2
        and all(f"`{a.arg}`" in doc.summary for a in arguments)
        and not any(_ARRAY.search(ast.unparse(a.annotation)) for a in arguments if a.annotation)
    )


def _parameter_complaints(node: Function, name: str, docs: list[Docstring]) -> Iterator[str]:
    documented = {n: t for doc in docs for n, t in doc.documented("Parameters", "Other Parameters").items()}
    for argument in _arguments(node):
        if argument.arg in ("self", "cls") or argument.arg.startswith("_"):
            continue
        annotation = ast.unparse(argument.annotation) if argument.annotation else ""
        yield from _entry_complaints(node.lineno, name, "Parameters", argument.arg, annotation, documented)
    known = {a.arg for a in _arguments(node)}
    for stale in sorted(n for n in documented if re.fullmatch(r"\w+", n) and n not in known):
        yield f"line {node.lineno}: {name} documents a parameter {stale!r} that it does not have"


def _entry_complaints(
    line: int, owner: str, section: str, name: str, annotation: str, documented: dict[str, str]
) -> Iterator[str]:
    if name not in documented:
        yield f"line {line}: {owner}: {name!r} is not documented under {section}"
    elif _ARRAY.search(annotation) and not _SHAPE.search(documented[name]):
        yield f"line {line}: {owner}: {name!r} is an array; {section} names no shape for it, e.g. (n_samples,)"


def _return_complaints(where: str, returned: str, doc: Docstring) -> Iterator[str]:
    text = doc.texts.get("Returns", doc.texts.get("Yields"))
    if not text:
        yield f"{where} returns {returned} and has no section Returns"
    elif _ARRAY.search(returned) and not _SHAPE.search(text):
        yield f"{where} returns an array; Returns names no shape, e.g. (n_samples,)"


def _raise_complaints(node: Function, where: str, doc: Docstring) -> Iterator[str]:
    raised = {name for name in _raised(node) if name not in _NOT_FOR_CALLERS}
    text = doc.texts.get("Raises", "")
    if raised and not text:
        yield f"{where} raises {', '.join(sorted(raised))} and has no section Raises"
        return
    for name in sorted(raised):
        if name.endswith("Error") and not re.search(rf"\b{name}\b", text):
            yield f"{where} raises {name}, which Raises does not name"


def _raised(node: Function) -> Iterator[str]:
    """Names in the function's own ``raise`` statements: neither those of nested functions nor bare re-raises."""
    pending: list[ast.AST] = list(node.body)
    while pending:
        item = pending.pop()
        if isinstance(item, Function | ast.Lambda | ast.ClassDef):
            continue
        if isinstance(item, ast.Raise) and item.exc is not None:
            target = item.exc.func if isinstance(item.exc, ast.Call) else item.exc
            yield ast.unparse(target).split(".")[-1]
        pending.extend(ast.iter_child_nodes(item))


def _decorators(node: Function) -> set[str]:
    return {ast.unparse(d).split("(")[0].split(".")[-1] for d in node.decorator_list}


def _is_property(node: Function) -> bool:
    return bool(_decorators(node) & {"property", "cached_property"})


def _arguments(node: Function) -> list[ast.arg]:
    a = node.args
    starred = [x for x in (a.vararg, a.kwarg) if x is not None]
    return [*a.posonlyargs, *a.args, *a.kwonlyargs, *starred]


def _has_fields(node: ast.ClassDef) -> bool:
    decorated = any("dataclass" in ast.unparse(d) for d in node.decorator_list)
    return decorated or any(ast.unparse(b).split(".")[-1] in ("NamedTuple", "TypedDict") for b in node.bases)


def _fields(node: ast.ClassDef) -> Iterator[tuple[str, str]]:
    for item in node.body:
        if isinstance(item, ast.AnnAssign) and isinstance(item.target, ast.Name):
            annotation = ast.unparse(item.annotation)
            if not item.target.id.startswith("_") and "ClassVar" not in annotation and annotation != "KW_ONLY":
                yield item.target.id, annotation
