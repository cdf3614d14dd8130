"""Where the config tree and the robot assets live: inside a wheel, or at the top of a checkout."""

from pathlib import Path

from koopdqn.errors import BadInputError, unknown_name

_PACKAGE = Path(__file__).resolve().parent


def roots() -> tuple[Path, Path]:
    """Return the folders searched for conf/ and assets/, first match wins.

    A wheel holds both inside the package. An editable install may hold a stale copy there only if
    someone built it by hand; normally the package has none and the checkout's own folders are used.
    """
    return _PACKAGE, _PACKAGE.parent


def conf_dir() -> Path:
    """Return the absolute folder of the config tree.

    Raises:
        BadInputError: no ``conf/config.yaml`` is installed.
    """
    return _folder("conf", marker="config.yaml")


def assets_dir() -> Path:
    """Return the absolute folder of the robot and scene assets.

    Raises:
        BadInputError: no ``assets/`` is installed.
    """
    return _folder("assets", marker=".")


def check_asset(name: str) -> None:
    """Raise unless the name of an asset leads nowhere but below assets/.

    Raises:
        BadInputError: it is absolute, or leads upwards.
    """
    if Path(name).is_absolute() or ".." in Path(name).parts or not name.isprintable():
        raise BadInputError(f"asset: must be the name of a file below assets/, found {name!r}")


def asset_path(name: str) -> Path:
    """Return the absolute path of the asset ``name``, given relative to assets/ (``"ur5/ur5.xml"``).

    Raises:
        BadInputError: the name leads out of assets/, or there is no such asset; the message lists those of the
            nearest existing folder.
    """
    check_asset(name)
    base = assets_dir()
    path = base / name
    if not path.is_file():
        folder = path if path.is_dir() else path.parent
        while not folder.is_dir():
            folder = folder.parent
        raise unknown_name("asset", name, [p.relative_to(base).as_posix() for p in folder.iterdir()])
    return path


def _folder(name: str, marker: str) -> Path:
    for root in roots():
        if (root / name / marker).exists():
            return root / name
    tried = ", ".join(str(root / name) for root in roots())
    raise BadInputError(f"{name}/ is not installed; looked for {tried}; install koopdqn again")
