"""The scenes that come with the software, how to name one, and what the keys of a scene say."""

import json
import tomllib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

from pydantic.fields import FieldInfo

from palpate.shared.part import Part
from palpate.shared.scene import Scene, SceneError, absent, kinds_of, load_scene

FOLDER = Path(__file__).parent

MEANINGS = 34
"""Column at which meanings stand, those of longer values on a line of their own."""


def shipped_scenes() -> list[str]:
    """Names of the scenes that come with the software."""
    return sorted(path.stem for path in FOLDER.glob("*.toml"))


def find_scene(name_or_path: str | Path) -> Scene:
    """Load a shipped scene by its name, or any other by its path.

    Raises
    ------
    SceneError
        If there is no such scene, or it is wrong.
    """
    return load_scene(_path_of(name_or_path))


@contextmanager
def opened_scene(name_or_path: str | Path) -> Iterator[Scene]:
    """Load a scene as `find_scene` does; a `SceneError` of what is made of it names its file."""
    path = _path_of(name_or_path)
    scene = load_scene(path)
    try:
        yield scene
    except SceneError as error:
        raise SceneError(f"{path}: {error}") from error


def _path_of(name_or_path: str | Path) -> Path:
    """File of a scene that comes along or of any other."""
    path = Path(name_or_path)
    if path.suffix == ".toml":
        return path
    names = shipped_scenes()
    if str(name_or_path) not in names:
        raise SceneError(f"{name_or_path}: neither a .toml file nor one of {', '.join(names)}")
    return FOLDER / f"{name_or_path}.toml"


def default_artifact(scene: Scene) -> Path:
    """Where a scene's artifact goes and is looked for."""
    return Path("artifacts") / f"{scene.name}.h5"


def filled(scene: Scene) -> str:
    """A scene's TOML with every default written out; each key with its unit and meaning."""
    return "\n".join(_lines(scene, "")) + "\n"


def given(scene: Scene) -> str:
    """The same of the keys alone that its text gives."""
    return "\n".join(_lines(scene, "", tomllib.loads(scene.text))) + "\n"


def _lines(part: Part, path: str, said: Mapping[str, Any] | None = None) -> Iterator[str]:
    tables = []
    for key, field in type(part).model_fields.items():
        if said is not None and key not in said:
            continue
        value, meaning = getattr(part, key), f"# {field.description}"
        if isinstance(value, Part):
            tables.append((key, meaning, value))
            continue
        line = f"{key} = {_toml(value)}"
        if value is None:
            line, meaning = f"# {key} =", f"{meaning} (if absent: {absent(field)})"
        if len(line) > MEANINGS:
            yield meaning
        yield line if len(line) > MEANINGS else f"{line:<{MEANINGS}} {meaning}"
    for key, meaning, table in tables:
        yield f"\n{f'[{path}{key}]':<{MEANINGS}} {meaning}"
        yield from _lines(table, f"{path}{key}.", None if said is None else said[key])


def _toml(value: object) -> str:
    """A value as TOML writes it: as JSON does, but for the brackets of tuples and tables."""
    if isinstance(value, Part):
        pairs = ((key, getattr(value, key)) for key in type(value).model_fields)
        return f"{{{', '.join(f'{k} = {_toml(v)}' for k, v in pairs if v is not None)}}}"
    if isinstance(value, tuple):
        return f"[{', '.join(map(_toml, value))}]"
    return json.dumps(value, ensure_ascii=False)


def reference() -> str:
    """Table of all keys of a scene, in Markdown: default, unit and meaning of each."""
    head = ["| key | if absent | unit and meaning |", "|---|---|---|"]
    return "\n".join([*head, *_rows(Scene, "")]) + "\n"


def _rows(part: type[Part], path: str) -> Iterator[str]:
    for key, field in part.model_fields.items():
        kinds = kinds_of(field)
        ends = ("[[", "]]") if get_origin(field.annotation) is tuple else ("[", "]")
        name = f"**`{ends[0]}{path}{key}{ends[1]}`**" if kinds else f"`{path}{key}`"
        yield f"| {name} | {'' if kinds else _default(field)} | {field.description} |"
        for kind in kinds:
            if kind is part:  # a table of its own kind within
                continue
            yield from _rows(kind, f"{path}{key}.")


def _default(field: FieldInfo) -> str:
    """What stands for a key that a scene does not give."""
    if not field.is_required():
        return absent(field) or f"`{_toml(field.default)}`"
    kinds = get_args(field.annotation) if get_origin(field.annotation) is Literal else ()
    return absent(field) or ": ".join(["required", *(f"`{_toml(kind)}`" for kind in kinds)])
