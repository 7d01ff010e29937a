"""The database that keeps a study, and what it answers in one line."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from optuna.exceptions import ExperimentalWarning, StorageInternalError
from optuna.storages import RDBStorage
from sqlalchemy.engine import make_url
from sqlalchemy.exc import ArgumentError, NoSuchModuleError, SQLAlchemyError

from ..model.console import one_line
from ..model.errors import Rts2Error, UsageError

LOCKED_S = 60
"""How long to wait for an SQLite file that another worker writes to."""


def sqlite(path: Path) -> str:
    """The URL of a study in a file."""
    return f"sqlite:///{path.resolve()}"


def opened(url: str, heartbeat_s: int, grace_s: int) -> RDBStorage:
    """The database at `url`, its tables made where there are none.

    A worker says that it lives every `heartbeat_s`, and is taken for dead after `grace_s`.
    """
    waiting = {"timeout": LOCKED_S} if url.startswith("sqlite") else {}
    return RDBStorage(
        _driven(url),
        engine_kwargs={"connect_args": waiting, "pool_pre_ping": True},
        heartbeat_interval=heartbeat_s,
        grace_period=grace_s,
    )


@contextmanager
def reached(url: str) -> Iterator[None]:
    """Turns what a database answers into one line that names the remedy.

    Raises:
        UsageError: the URL is none, or its driver is missing.
        Rts2Error: the database cannot be reached, or its tables are another version's.
    """
    told = without_password(url)
    try:
        with warnings.catch_warnings():
            # Heartbeats are declared experimental, and say so each time.
            warnings.simplefilter("ignore", ExperimentalWarning)
            yield
    except (ArgumentError, NoSuchModuleError) as error:
        raise UsageError(
            "--storage must be a database's URL, such as sqlite:///study.db or "
            f"postgresql://user@host/name, not {told}"
        ) from error
    except ImportError as error:
        raise UsageError(
            f"--storage {told} needs a driver that is not installed: {one_line(error)}; pip "
            "install 'rts2[postgresql]' brings PostgreSQL's"
        ) from error
    except (StorageInternalError, SQLAlchemyError) as error:
        cause = error.__cause__ or error
        reason = one_line(str(getattr(cause, "orig", None) or cause)).partition(" Is the ")[0]
        raise Rts2Error(
            f"--storage {told} does not answer ({reason.strip()}); start the server or correct the "
            "URL, and the same command goes on from here"
        ) from error
    except RuntimeError as error:
        raise Rts2Error(f"--storage {told}: {one_line(error)}; take another database") from error


def _driven(url: str) -> str:
    """A plain `postgresql://` means the driver that `rts2[postgresql]` brings, whatever the one is
    that SQLAlchemy would take.
    """
    known = make_url(url)
    if known.drivername == "postgresql":
        known = known.set(drivername="postgresql+psycopg2")
    return known.render_as_string(hide_password=False)


def without_password(url: str) -> str:
    """A URL as it may be shown."""
    try:
        return make_url(url).render_as_string(hide_password=True)
    except (ArgumentError, ValueError):
        return url
