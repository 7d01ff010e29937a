"""The two actions of rts2-profile that a device out of reach needs: kit and import."""

from __future__ import annotations

import argparse
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

from ...model.arch import Precision
from ...model.console import add_output, print_json, progress, screen
from ...model.errors import UsageError
from ...model.files import output_file, read_json, write_json
from ..conformal import half_width
from ..profile import Profile, load

if TYPE_CHECKING:
    from .results import Timings

CONFIDENCE = 0.9


def add_actions(actions: Any, known: str) -> None:
    """Adds `kit` and `import`; `known` says which devices there are."""
    made = actions.add_parser("kit", help="a folder that times networks on a device out of reach")
    made.add_argument("--device", required=True, help=known)
    text = "folder for the kit (default: kit)"
    made.add_argument("--out", type=Path, default=Path("kit"), metavar="DIR", help=text)
    text = "comma-separated, such as fp32,fp16 (default: all that the device and a kit run)"
    made.add_argument("--precision", type=_precisions, metavar="P,…", help=text)
    add_output(made, out=None)

    taken = actions.add_parser("import", help="a profile from the results of a kit")
    taken.add_argument("results", type=Path, metavar="RESULTS", help="the kit's kit-results.json")
    taken.add_argument("--device", required=True, help=f"what the kit was made for: {known}")
    taken.add_argument("--out", type=Path, required=True, metavar="FILE", help="the new profile")
    add_output(taken, out=None)


def _precisions(text: str) -> tuple[Precision, ...]:
    names = text.split(",")
    unknown = [name for name in names if name not in get_args(Precision)]
    if unknown or len(set(names)) < len(names):
        rule = f"must be {', '.join(get_args(Precision))}, each once, separated by commas"
        raise argparse.ArgumentTypeError(f"{rule}, not {text!r}")
    return tuple(name for name in get_args(Precision) if name in names)


def kit(options: argparse.Namespace) -> None:
    """Writes a kit and says what to do with it."""
    from .folder import default_precisions, refuse, write

    profile = load(options.device)
    precisions = options.precision or default_precisions(profile)
    refuse(profile, precisions)
    made = write(profile, precisions, options.out, progress=progress)
    if options.json:
        print_json(
            {
                "schema": "rts2.profile-kit/1",
                "device": made.device,
                "kit": made.kit,
                "folder": str(options.out),
                "precisions": list(made.precisions),
                "networks": len(made.networks),
            }
        )
        return
    screen().print(
        f"{len(made.networks)} networks in {' and '.join(made.precisions)} for {profile.title}: "
        f"{options.out}\n"
        f"copy it to the device; there: sh run.sh, then python3 collect.py; here again:\n"
        f"    rts2-profile import kit-results.json --device {options.device} "
        f"--out {profile.name}-mine.json"
    )


def import_results(options: argparse.Namespace) -> None:
    """Writes the profile that a kit's results make of a device's."""
    from .imported import profile_of
    from .results import Results, timings

    profile = load(options.device)
    path = output_file(options.out)
    results = read_json(options.results, Results, "a kit's results")
    told = timings(results, profile)
    for note in told.notes:
        _note(note)
    found = profile_of(told, profile, _name(path))
    write_json(path, found.model_dump(mode="json", by_alias=True, exclude_none=True))
    _report(options, found, told, path)


def _name(path: Path) -> str:
    name = re.sub("[^a-z0-9._-]+", "-", path.stem.lower()).strip("._-")
    if not name:
        raise UsageError(f"--out must have a letter or a digit in its name, not {path.name!r}")
    return name


def _report(options: argparse.Namespace, found: Profile, told: Timings, path: Path) -> None:
    from ..calibrate import summary

    rows = []
    for precision, points in told.points.items():
        known = found.calibration(points[0].runtime, precision)
        width = half_width(known.residuals, CONFIDENCE)
        rows.append(
            {
                "runtime": known.runtime,
                "precision": precision,
                "n": len(points),
                **summary(known.residuals),
                "half_width_90": width,
            }
        )
    if options.json:
        result = {"schema": "rts2.profile-import/1", "file": str(path), "calibrations": rows}
        print_json(result | {"notes": list(told.notes)})
        return
    for row in rows:
        screen().print(
            f"{row['runtime']} {row['precision']}: {row['n']} timings, each left out in turn: "
            f"mean error {row['mape']:.1%}, worst {row['max_ape']:.1%}; "
            f"{CONFIDENCE:.0%} interval ±{row['half_width_90']:.1%}"
        )
    screen().print(f"written   {path}")


def _note(text: str) -> None:
    from rich.console import Console

    Console(stderr=True, markup=False).print(f"note: {text}", highlight=False, soft_wrap=True)
