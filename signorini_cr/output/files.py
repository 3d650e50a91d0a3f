"""Files that appear whole or not at all, written by all ranks together."""

from __future__ import annotations

import fcntl
import os
import shutil
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from mpi4py import MPI

from ..errors import InputError, insist_on_kind, on_root

Where = str | os.PathLike[str]
"""A path."""

Writer = Callable[[Path], object]
"""Writes one file; called on every rank, and raises on every rank if at all."""

STAGE = ".signorini-cr-"
"""Prefix of the names of hidden folders in which files are written at first."""


def as_path(path: Where) -> Path:
    """Take a path, or refuse what is none."""
    insist_on_kind("path", path, (str, os.PathLike), "the path of a file")
    return Path(path)


@contextmanager
def disk_errors(path: Path) -> Iterator[None]:
    """Turn the system's refusal to write `path` into the InputError a user understands."""
    try:
        yield
    except OSError as error:
        raise InputError(f"cannot write {path.name}: {error.strerror or error}") from error


def check_writable(
    folder: Where, names: Iterable[str] = (), comm: MPI.Comm = MPI.COMM_WORLD
) -> None:
    """Raise InputError on all ranks if files could not be put into a folder; leave no trace.

    Args:
        folder: Need not be there.
        names: The files to come; none of them may be a folder.
        comm: The ranks that take part; all must call.
    """

    def look() -> None:
        path = Path(folder)
        anchor = _nearest(path)
        if not anchor.is_dir():
            raise InputError(f"cannot write to {path}: {anchor} is not a folder")
        try:
            path.lstat()
        except FileNotFoundError:
            pass
        except OSError as error:  # a name that is too long, for one
            raise InputError(f"cannot write to {path}: {error.strerror}") from error
        try:  # permissions don't tell all, of /proc for one
            _clear(anchor)
            with _stage_in(anchor):
                pass
        except OSError as error:
            raise InputError(
                f"cannot write to {path}: {anchor} is not writable ({error.strerror})"
            ) from error
        for name in names:
            if (path / name).is_dir():
                raise InputError(f"cannot write {path / name}: a folder of that name is there")

    on_root(comm, look)


def write_files(
    folder: Where,
    writers: Mapping[str, Writer],
    removed: Sequence[str] = (),
    comm: MPI.Comm = MPI.COMM_WORLD,
    begins: bool = False,
) -> list[str]:
    """Put files into a folder: all of them or, if a writer raises, none.

    They are written into a hidden folder inside and renamed into place. Where the process is
    killed before it has taken that folder away, the next `check_writable` does.

    Args:
        folder: Made if it is not there, and if a file is written. Other files in it are left alone.
        writers: What writes the file of each name to the path that it is given. The first file
            vouches for the others: it goes before any of `removed` and comes last, so that
            wherever it is found, there is nothing of a former run beside it. Another may leave
            its file out.
        removed: Names that shall not be there afterwards unless they were written; the last of
            them goes just before the first file comes.
        comm: The ranks that take part; all must call.
        begins: Whether these are the first of a run: all that is there is another one's then, and
            the file that vouches goes before any is replaced.

    Returns:
        The names of what was written.

    Raises:
        InputError: The system refuses to write.
    """
    path = Path(folder)
    held = ExitStack()  # rank 0's

    def prepare() -> str:
        with disk_errors(path):
            held.enter_context(_there(path))
            return str(held.enter_context(_stage_in(path)))

    def publish() -> list[str]:
        first, *others = written = [name for name in writers if (stage / name).exists()]
        obsolete = [path / name for name in removed if name not in written]
        with disk_errors(path):
            if begins or any(map(os.path.lexists, obsolete)):
                (path / first).unlink(missing_ok=True)
            for each in obsolete[:-1]:
                each.unlink(missing_ok=True)
            for name in others:
                os.replace(stage / name, path / name)
            for each in obsolete[-1:]:
                each.unlink(missing_ok=True)
            os.replace(stage / first, path / first)
        held.close()  # before another rank looks
        return written

    with held:
        stage = Path(on_root(comm, prepare))
        for name, write in writers.items():
            write(stage / name)
        return on_root(comm, publish)


@contextmanager
def _there(folder: Path) -> Iterator[None]:
    """Make a folder, and those it is in; what is empty in the end goes again."""
    missing = [place for place in (folder, *folder.absolute().parents) if not place.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        yield
    finally:
        with suppress(OSError):  # what is in one that does not go may be written with `..`
            for place in missing:
                place.rmdir()


@contextmanager
def _stage_in(folder: Path) -> Iterator[Path]:
    """Have a hidden folder, which the next `check_writable` removes if this process is killed."""
    stage, lock = _enter(folder)
    try:
        yield stage
    finally:
        shutil.rmtree(stage, ignore_errors=True)
        os.close(lock)


def _enter(folder: Path) -> tuple[Path, int]:
    """Make a hidden folder, and the lock that says that its process is alive."""
    while True:
        stage = Path(tempfile.mkdtemp(prefix=STAGE, dir=folder))
        lock = os.open(stage, os.O_RDONLY)
        _locks(lock)
        if stage.exists():  # another run can take it away before it is locked
            return stage, lock
        os.close(lock)


def _locks(lock: int) -> bool:
    """Lock a folder unless another process holds it or the file system knows no locks."""
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    return True


def _clear(folder: Path) -> None:
    """Remove the hidden folders that processes which were killed have left behind."""
    for stage in folder.glob(STAGE + "*"):
        try:
            lock = os.open(stage, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
        except OSError:  # not ours, or gone meanwhile
            continue
        if _locks(lock):
            shutil.rmtree(stage, ignore_errors=True)
        os.close(lock)


def _write_text(path: Path, make: Callable[[], str]) -> None:
    """Write what `make` returns; called on one rank."""
    with disk_errors(path):
        path.write_text(make(), encoding="utf-8")


def text_writer(comm: MPI.Comm, make: Callable[[], str]) -> Writer:
    """Return what writes the text that `make` returns on rank 0."""
    return lambda path: on_root(comm, _write_text, path, make)


def _nearest(path: Path) -> Path:
    """Return the path itself if it is there, or else the nearest folder it would be made in."""
    # a link that leads nowhere is there, too
    return next(place for place in (path, *path.absolute().parents) if os.path.lexists(place))
