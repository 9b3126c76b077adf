"""The scenes that come with the software, and how to name one."""

from pathlib import Path

from palpate.shared.scene import Scene, SceneError, load_scene

FOLDER = Path(__file__).parent


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
    path = Path(name_or_path)
    if path.suffix != ".toml":
        if str(name_or_path) not in shipped_scenes():
            raise SceneError(
                f"{name_or_path}: neither a .toml file nor one of {', '.join(shipped_scenes())}"
            )
        path = FOLDER / f"{name_or_path}.toml"
    return load_scene(path)


def default_artifact(scene: Scene) -> Path:
    """Where a scene's artifact goes and is looked for."""
    return Path("artifacts") / f"{scene.name}.h5"
