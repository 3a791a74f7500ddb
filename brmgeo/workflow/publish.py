"""Results under stable names: copies of what the store holds, each whole or as it was before."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from pathlib import Path

from brmgeo import files
from brmgeo.workflow.disk import disk_errors
from brmgeo.workflow.stage import Json
from brmgeo.workflow.store import Artifact

PUBLISHED = ".brmgeo-published.json"


def publish(
    artifact: Artifact, out_dir: Path | str, names: Mapping[str, str] | Iterable[str], say: files.Say
) -> list[str]:
    """Copies outputs (files, or folders with all in them) to ``out_dir`` under stable names; the names that were written.

    ``names`` maps names in the artifact to names in ``out_dir``, or lists names that stay the same. Each file
    is replaced at once, never half written, and only when it is not the one published before: files that an earlier
    artifact put into a published folder and this one lacks are removed. The copies are no links, since programs like
    QGIS write into the files that they open. A file that somebody changed since it was published, or that never was, stays
    as it is while there is nothing newer, and is set aside (``files.set_aside``) where there is; ``say`` is told.

    Raises WorkflowError when ``out_dir`` cannot be written, KeyError when the artifact has no such output.
    """
    out = Path(out_dir).absolute()
    wanted: dict[str, tuple[str, Json]] = {}
    roots = []
    outputs = artifact.record["outputs"]
    for name, target in (names if isinstance(names, Mapping) else {n: n for n in names}).items():
        inside = {n: target + n[len(name) :] for n in outputs if n == name or n.startswith(f"{name}/")}
        if not inside and not (artifact.path / name).is_dir():
            raise KeyError(
                f"stage {artifact.step.label} has no output {name}; it has {', '.join(sorted(outputs))}"
            )
        roots.append(target)
        wanted |= {goal: (source, outputs[source]) for source, goal in inside.items()}
    written = []
    with disk_errors(f"results in {out}", out):
        out.mkdir(parents=True, exist_ok=True)
        for folder in {out, *((out / goal).parent for goal in wanted)}:
            files.clear_scratch(folder, older_than_s=0.0)
        known = _known(out)
        before = dict(known)
        try:
            for goal, (source, entry) in sorted(wanted.items()):
                place, digest = out / goal, entry["sha256"]
                if goal in known and known[goal] == [digest, *_look(place)]:
                    continue
                if os.path.lexists(place) and not _is_published(
                    place, known.get(goal), artifact.path / source
                ):
                    if goal in known and known[goal][0] == digest:
                        say(
                            f"{place}: changed since brmgeo wrote it, and left as it is: remove it to have it anew"
                        )
                        continue
                    files.set_aside(out, [goal], say)
                place.parent.mkdir(parents=True, exist_ok=True)
                files.copy(artifact.path / source, place)
                known[goal] = [digest, *_look(place)]
                written.append(goal)
            for goal in [g for g in known if g not in wanted and any(g.startswith(f"{r}/") for r in roots)]:
                _withdraw(out / goal, known.pop(goal), say)
        finally:
            if known != before:
                files.write_json(out / PUBLISHED, known, durable=True)
        files.sync(out)
    return written


def withdraw(out_dir: Path | str, names: Iterable[str], say: files.Say) -> None:
    """Removes files that were published and nothing replaces; one that somebody changed stays, which ``say`` is told."""
    out = Path(out_dir).absolute()
    with disk_errors(f"results in {out}", out):
        known = _known(out)
        for name in names:
            _withdraw(out / name, known.pop(name, None), say)
        files.write_json(out / PUBLISHED, known, durable=True)


def _withdraw(place: Path, known: Json, say: files.Say) -> None:
    if known is not None and place.is_file() and known[0] != files.digest(place):
        say(f"{place}: not as brmgeo wrote it, so it is kept, though it belongs to earlier results")
    else:
        place.unlink(missing_ok=True)


def _known(out: Path) -> dict[str, Json]:
    """[digest, size, time] of each file by its name, as far as the list in the folder can be made out."""
    known = files.read_json(out / PUBLISHED)
    return {
        name: entry
        for name, entry in (known.items() if isinstance(known, dict) else ())
        if isinstance(entry, list) and len(entry) == 3
    }


def _is_published(place: Path, known: Json, source: Path) -> bool:
    """Whether a file still is what was published, or what is to be: then nothing is lost with it."""
    if place.is_symlink() or not place.is_file():
        return False
    found = files.content_digest(place)
    return found == files.content_digest(source) or (
        known is not None and known[0] in (found, files.digest(place))
    )


def _look(path: Path) -> tuple[int, ...]:
    """Size and time of a published file, (-1, -1) when absent: copies of the results keep them, unlike inodes."""
    try:
        s = path.stat()
    except FileNotFoundError:
        return (-1, -1)
    return (s.st_size, s.st_mtime_ns)
