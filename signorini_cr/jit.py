"""Compiling forms, wherever there is room, and whatever runs that were ended have left behind.

FFCx begins with an empty source file in a folder that all programs share, and ends with a mark
beside it; where the mark is missing, it waits for whoever may be at work, ten seconds by default,
and gives up. After a run that was killed in between, every run would give up, for ever. It loads
what it finds there: a library that was cut short by a full disk would take the program along.
"""

from __future__ import annotations

import atexit
import hashlib
import json
import os
import re
import shutil
import struct
import tempfile
import time
import warnings
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import wraps
from importlib.machinery import EXTENSION_SUFFIXES
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType
from typing import Any, TypeAlias, TypeVar

import cffi
from dolfinx import jit
from ffcx.codegeneration import jit as ffcx_jit
from ffcx.options import FFCX_DEFAULT_OPTIONS
from mpi4py import MPI

from . import temporary
from .errors import InputError, naming, on_root
from .hints import meant

T = TypeVar("T")
Loaded: TypeAlias = tuple[list[Any], ModuleType]
"""A loaded form, as FFCx asks for it: its objects, and the module that holds them."""

ABANDONED = 60.0
"""Seconds without a change from which on a source file without mark belongs to nobody."""
OWN = "signorini-cr-forms-"
"""Prefix of temporary folders' names; the number of their process follows."""

tell: Callable[[str], Any] = warnings.warn
"""Called on all ranks with what a user should know."""

_elsewhere: str | None = None
"""The folder that takes the place of the shared one, once that has turned out to be no good."""


def compiled(comm: MPI.Comm, build: Callable[..., T], *args: object) -> T:
    """Call `build(*args)`, which compiles, as often as that takes; collective.

    Args:
        comm: The ranks that compile together.
        build: `dolfinx.fem.form`, `compile_form` or `Expression`.
        *args: Handed over to `build`.

    Returns:
        What `build` returns.

    Raises:
        InputError: There is no folder to compile in, no compiler that works, or a file with options
            that is none.
    """
    began = time.time() - 0.1  # the clock that files are dated by may lag a little
    while True:
        place = {} if _elsewhere is None else {"jit_options": {"cache_dir": _elsewhere}}
        try:
            return build(*args, **place)
        except (OSError, RuntimeError, ImportError, cffi.VerificationError, *_UNUSABLE) as error:
            # With several ranks DOLFINx raises RuntimeError on all of them, rank 0's with the words
            if comm.size > 1 and not re.search("(JIT|just-in-time) compilation", str(error)):
                raise
            if comm.bcast(comm.rank == 0 and _waited_in_vain(str(error)), root=0):
                continue
            on_root(comm, _check_options)
            if isinstance(error, _UNUSABLE):
                raise
            if not _moved(comm):
                _tell_of_compiler(comm, error)
                raise
        except (KeyboardInterrupt, SystemExit):
            if comm.rank == 0:
                remove_unfinished(began)
            raise


_UNUSABLE = TypeError, ValueError, AttributeError
"""Errors of DOLFINx and FFCx over a file with options that they can't use, among others."""


def _check_options() -> None:
    """Insist on files with options, for who has any, that DOLFINx and FFCx can use."""
    settings = Path(os.environ.get("XDG_CONFIG_HOME") or Path.home() / ".config")
    usual = {key: value for key, (value, _) in jit.DOLFINX_DEFAULT_JIT_OPTIONS.items()}
    of_forms = {key: value for key, (_, value, *_) in FFCX_DEFAULT_OPTIONS.items()}
    usual |= {"cache_dir": str(usual["cache_dir"]), "cffi_libraries": []}
    for library, name, known in (
        ("dolfinx", "dolfinx_jit_options.json", usual),
        ("ffcx", "ffcx_options.json", of_forms),
    ):
        for path in (settings / library / name, Path.cwd() / name):
            with naming(path):
                _check_file(path, known)


def _check_file(path: Path, usual: Mapping[str, Any]) -> None:
    """Insist on known keys, and on values of the kinds that the usual ones have."""
    try:
        found = json.loads(path.read_text())
    except FileNotFoundError:
        return
    except (OSError, ValueError) as error:
        raise InputError(f"this is no JSON that can be read ({error})") from error
    if not isinstance(found, dict):
        raise InputError("a JSON object is needed, a value for each option")
    for key, value in found.items():
        if key not in usual:
            raise InputError(f"there is no option {key!r}; {meant(key, usual)}")
        kind: tuple[type, ...] = (type(usual[key]),)
        kind += (int,) if kind == (float,) else ()
        words = isinstance(value, list) and not all(isinstance(each, str) for each in value)
        if not isinstance(value, kind) or words:
            needed = "a list of words" if kind == (list,) else f"a value like {usual[key]!r}"
            raise InputError(f"{key} is {value!r}; {needed} is needed")


def _waited_in_vain(words: str) -> bool:
    """Tell whether FFCx has given up waiting; the source file goes if nobody is at work at it."""
    found = re.search(r"timed out.*remove (.*\.c)\)", words, re.DOTALL)
    if found is None:
        return False
    source = Path(found[1])
    with suppress(OSError):
        if time.time() - source.stat().st_mtime > ABANDONED:
            source.unlink()
    return True


def _moved(comm: MPI.Comm) -> bool:
    """Go elsewhere if the folder for compiled forms can't be written to; collective."""
    global _elsewhere
    folder = _elsewhere or str(jit.get_options()["cache_dir"])

    def move() -> tuple[str, str] | None:
        found = _fault(Path(folder))
        if found is None:
            place = tempfile.gettempdir()
            if (found := temporary.fault(place)) is None:
                return None
            raise InputError(
                f"forms cannot be compiled: the folder for temporary files, {place}, cannot be"
                f" written to ({found}); TMPDIR may name another"
            )
        words = f"compiled forms cannot be kept in {folder} ({found})"
        try:
            if _elsewhere is None:
                return _own_folder(), words
        except OSError as error:
            words += f", nor in a temporary folder ({error.strerror})"
        raise InputError(f"{words}; XDG_CACHE_HOME may name another folder")

    found = on_root(comm, move)
    if found is None:
        return False
    _elsewhere, words = found
    tell(f"{words}: they are compiled for this run only")
    return True


def _tell_of_compiler(comm: MPI.Comm, error: BaseException | None) -> None:
    """Raise InputError if it is the compiler that has failed on rank 0; collective."""
    words, origin = None, error
    while comm.rank == 0 and words is None and error is not None:
        if found := _FAILED.search(str(error)):
            words = _ARGUMENTS.sub(r"\1", found[1].rstrip("."))
        error = error.__cause__ or error.__context__
    if (words := comm.bcast(words)) is not None:
        raise InputError(
            f"forms cannot be compiled: {words}; a C compiler that works is needed, and CC may"
            " name it; numbers in forms must be finite"
        ) from origin


_FAILED = re.compile(r"(?:Compile|Link|Platform)Error: (.*)")
"""Words of cffi where a command has failed."""
_ARGUMENTS = re.compile(r"'\['([^']+)'.*\]'")
"""A command with its arguments, as some versions of setuptools tell them."""


def _fault(folder: Path) -> str | None:
    """Say in words what keeps us from writing into a folder."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        return error.strerror or str(error)
    return temporary.fault(folder)


def _own_folder() -> str:
    """Make a temporary folder, gone when the process ends; remove those of killed processes."""
    for left in Path(tempfile.gettempdir()).glob(f"{OWN}*"):
        number = left.name.removeprefix(OWN).split("-")[0]
        if number.isdigit() and not Path(f"/proc/{number}").exists():
            shutil.rmtree(left, ignore_errors=True)
    folder = tempfile.mkdtemp(prefix=f"{OWN}{os.getpid()}-")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


def remove_unfinished(since: float = 0.0, until: float = float("inf")) -> None:
    """Remove source files without mark that were last changed in an interval of time."""
    folder = Path(jit.get_options()["cache_dir"])
    for source in folder.glob("libffcx_*.c"):
        with suppress(OSError):
            marked = source.with_suffix(".c.cached").exists()
            if not marked and since <= source.stat().st_mtime <= until:
                source.unlink()


# What is loaded is looked at first: its end, and a sum of it that was noted when it was made


def _note(library: Path) -> Path:
    return library.with_name(library.name.split(".")[0] + ".sum")


def _sum(library: Path) -> str:
    return hashlib.blake2b(library.read_bytes(), digest_size=16).hexdigest()


def _mark(folder: Path, name: str) -> Path:
    """Name what FFCx puts beside a form's source file when its library is whole."""
    return folder / f"{name}.c.cached"


def _library(folder: Path, name: str) -> Path | None:
    """Find a form's shared library, if it is there."""
    places = (folder / (name + suffix) for suffix in EXTENSION_SUFFIXES)
    return next((place for place in places if place.exists()), None)


def _write_note(library: Path) -> None:
    """Note what a library is like; where that can't be written, it is done without."""
    with suppress(OSError):
        note = _note(library)
        part = note.with_suffix(f".{os.getpid()}")
        part.write_text(_sum(library))
        part.replace(note)


def _ends_early(library: Path) -> bool:
    """Tell whether a shared library is shorter than its head says, which ends in a bus error."""
    with library.open("rb") as file:
        head = file.read(64)
    if head[:5] != b"\x7fELF\x02":  # another system's, of which nothing is known here
        return len(head) < 64
    (sections,), (size, number) = (
        struct.unpack_from("<Q", head, 40),
        struct.unpack_from("<HH", head, 58),
    )
    return library.stat().st_size < sections + size * number


def _remove_damaged(folder: Path, name: str) -> None:
    """Take a form away whose library is not as it was made, so that it is compiled anew."""
    mark, library = _mark(folder, name), _library(folder, name)
    if not mark.exists():
        return
    if library is not None and not _ends_early(library):
        try:
            if _note(library).read_text() == _sum(library):
                return
        except FileNotFoundError:
            _write_note(library)
            return
    try:
        mine = mark.replace(mark.with_suffix(f".{os.getpid()}"))
    except FileNotFoundError:  # another process is at it
        return
    source = folder / f"{name}.c"
    for path in (source.with_suffix(".sum"), library, source, mine):
        if path is not None:
            path.unlink(missing_ok=True)


def _load(library: Path, name: str, objects: Any) -> Loaded:
    """Load a form's library from where it is known to be."""
    # FFCx has Python list the folder instead, for each form, and there may be thousands in it
    spec = spec_from_file_location(name, library)
    assert spec is not None and spec.loader is not None
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return [getattr(module.lib, each) for each in objects], module


def _watch() -> None:
    """Have FFCx look before it loads, load a form once only, and note what it makes."""
    find, load = ffcx_jit.get_cached_module, ffcx_jit._load_objects
    known: dict[tuple[str, str], Loaded] = {}

    @wraps(find)
    def found(module_name: str, object_names: Any, cache_dir: Any, *others: Any) -> Any:
        key = str(cache_dir), module_name
        if key not in known:
            folder = Path(cache_dir)
            _remove_damaged(folder, module_name)
            library = _library(folder, module_name)
            if library is None or not _mark(folder, module_name).exists():
                return find(module_name, object_names, cache_dir, *others)
            known[key] = _load(library, module_name, object_names)
        return known[key]

    @wraps(load)
    def loaded(cache_dir: Any, module_name: str, *others: Any) -> Any:
        library = _library(Path(cache_dir), module_name)
        if library is not None:
            _write_note(library)
        return load(cache_dir, module_name, *others)

    ffcx_jit.get_cached_module, ffcx_jit._load_objects = found, loaded


_watch()
