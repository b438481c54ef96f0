"""``placerec calibrate``: choose the threshold and the margin of a map from measurements."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import typer

from core.errors import InvalidImage, InvalidRecording
from service.commands.connection.client import AsJson, CommandTarget, DataDir, MapId, Url, ask, media_type, path_of
from service.commands.console import Failure, number, remark, say, show, show_json, table
from service.commands.encoders.models import ModelsDir, models_directory, open_catalogue
from service.commands.encoders.pictures import FEWEST_IMAGES, MOST_HELD_OUT, find_images, measured
from service.commands.jobs import submit
from service.commands.options.recordings import RecordingOptions, Topic

SHOWN_POINTS = 9


def calibrate(
    map_id: MapId,
    frames: Annotated[
        Path | None,
        typer.Option(
            help="CSV with the columns file,place of labelled frames beside it; leave place empty if the map lacks it."
        ),
    ] = None,
    recording: Annotated[
        Path | None,
        typer.Option(
            help="With --frames: a bag or a video. The column file then has ids of its frames, as query --json shows."
        ),
    ] = None,
    topic: Topic = None,
    camera: Annotated[
        str | None, typer.Option(help="Camera of the map that took the labelled frames; its mask is applied.")
    ] = None,
    sequence: Annotated[
        str | None, typer.Option(help="Ask for the frames of this traverse of the map in its other traverses.")
    ] = None,
    pairs: Annotated[
        Path | None,
        typer.Option(help="With --sequence: CSV with the columns place,shows of equal places; default: by pose."),
    ] = None,
    itself: Annotated[
        bool,
        typer.Option(
            "--itself", help="Ask for the map's own frames among their neighbours: less reliable, but needs no labels."
        ),
    ] = False,
    runs: Annotated[
        bool,
        typer.Option("--runs", help="By the frames of robots' sessions whose place the whole run knew beyond doubt."),
    ] = False,
    packaged: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="PATH",
            help="MAP is an installed encoder: measure the calibration that it ships with on these pictures; may be "
            "repeated.",
        ),
    ] = None,
    precision: Annotated[
        float | None, typer.Option(help="Share of the recognized answers that is to be right; default: 0.95.")
    ] = None,
    false_accept_rate: Annotated[
        float | None, typer.Option(help="Greatest share of frames of unknown places that may be recognized.")
    ] = None,
    mean_of_negatives: Annotated[
        bool, typer.Option("--mean-of-negatives", help="Use the rule of the thesis (section 3.4.3).")
    ] = False,
    most: Annotated[int | None, typer.Option(help="Most stored frames to ask for; they are spread evenly.")] = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Measure and report only; store nothing.")] = False,
    models_dir: ModelsDir = None,
    url: Url = None,
    data_dir: DataDir = None,
    as_json: AsJson = False,
) -> None:
    """Choose the threshold, the margin and the probabilities of a map by frames whose place is known.

    With --packaged: those of an encoder, for maps that have no calibration of their own, by any pictures of places.
    """
    if (frames is not None) + (sequence is not None) + itself + runs + (packaged is not None) != 1:
        raise typer.BadParameter("give exactly one of --frames, --sequence, --itself, --runs and --packaged")
    if packaged is not None:
        if precision is not None or false_accept_rate is not None or mean_of_negatives or most is not None:
            raise typer.BadParameter("--packaged takes no target and no --most")
        _calibrate_encoder(map_id, packaged, models_dir, dry_run, as_json)
        return
    if pairs is not None and sequence is None:
        raise typer.BadParameter("--pairs needs --sequence")
    for option, value in (("--camera", camera), ("--recording", recording)):
        if value is not None and frames is None:
            raise typer.BadParameter(f"{option} needs --frames")
    if topic is not None and recording is None:
        raise typer.BadParameter("--topic needs --recording")
    order: dict[str, Any] = {"target": _target(precision, false_accept_rate, mean_of_negatives), "dry_run": dry_run}
    order |= {} if most is None else {"most": most}
    target, path = CommandTarget(url, data_dir), path_of("maps", map_id, "calibrate")
    if frames is not None:
        rows = _rows(frames, ("file", "place"))
        names = [f"frame-{index}" for index in range(len(rows))]
        order |= {
            "method": "frames",
            "labels": [
                {"file": name, "place": place or None, "camera": camera}
                for name, (_, place) in zip(names, rows, strict=True)
            ],
        }
        parts: list[tuple[str, Any]] = [("calibration", (None, json.dumps(order), "application/json"))]
        files = [file for file, _ in rows]
        labelled = _pictures(frames.parent, files) if recording is None else _of_recording(recording, topic, files)
        for name, file, data in zip(names, files, labelled, strict=True):
            parts.append((name, (file, data, media_type(data))))
        report = ask(target, "POST", path, files=parts).json()
    else:
        order |= {"method": "map" if itself else "runs"} if sequence is None else {"method": "sequence"}
        order |= {} if sequence is None else {"sequence": sequence}
        if pairs is not None:
            order["pairs"] = {place: shown or None for place, shown in _rows(pairs, ("place", "shows"))}
        job = submit(
            target, path, order | {"background": True}, wait=True
        )  # it may take longer than a request is allowed to
        if job["state"] != "succeeded":
            raise Failure(job["problem"]["detail"] if job["problem"] else f"The job {job['id']} was cancelled.")
        report = job["result"]
    show_json(report) if as_json else _show(report)


def _calibrate_encoder(name: str, pictures: list[Path], models_dir: Path | None, dry_run: bool, as_json: bool) -> None:
    """Measure the calibration that an installed encoder ships with, and put it into the encoder's file."""
    from core.method.catalogue import ENCODER_SUFFIX, PACKAGED, save_calibration

    encoder = open_catalogue(models_dir).get(name)
    path = models_directory(models_dir) / f"{encoder.name}{ENCODER_SUFFIX}"
    if not dry_run and (PACKAGED / path.name).exists():
        raise Failure(f"{encoder.name} belongs to placerec and stays as it is; calibrate a map, or use --dry-run.")
    found = measured(encoder, find_images(pictures, FEWEST_IMAGES)[:MOST_HELD_OUT])
    if not dry_run:
        try:
            save_calibration(path, found)
        except OSError as error:
            raise Failure(f"{path} cannot be written: {error.strerror or error}.") from error
    if as_json:
        show_json({"encoder": encoder.identity, "stored": not dry_run, "calibration": found.model_dump(mode="json")})
        return
    say(
        f"{encoder.identity} {'would be' if dry_run else 'is'} calibrated by {found.frames} pictures: threshold "
        f"{number(found.threshold)}, margin {number(found.margin)}."
    )
    if found.curve is None:
        remark("The pictures are all alike, or distinguished without a mistake: no probabilities could be fitted.")
    if not dry_run:
        remark("A service that has loaded the encoder already keeps the old calibration until it is started again.")


def _pictures(folder: Path, files: list[str]) -> Iterator[bytes]:
    """The bytes of picture files, in their order."""
    from core.recordings.folder import read_picture

    for file in files:
        try:
            yield read_picture(folder / file)
        except OSError as error:
            raise Failure(f"{folder / file} cannot be read: {error.strerror}.") from error
        except InvalidImage as error:
            raise Failure(f"{file}: {error}") from error


def _of_recording(path: Path, topic: str | None, ids: list[str]) -> Iterator[bytes]:
    """The bytes of some frames of a recording, in their order."""
    with RecordingOptions(topic).open(path) as recording:
        frames = {frame.id: frame for frame in recording.frames}
        for name in ids:
            if name not in frames:
                raise Failure(f"{path} has no frame {name!r}; placerec query --json shows the ids of its frames.")
            try:
                yield frames[name].load()
            except (InvalidImage, InvalidRecording) as error:
                raise Failure(f"{name}: {error}") from error


def _target(precision: float | None, false_accept_rate: float | None, mean_of_negatives: bool) -> dict[str, Any]:
    if (precision is not None) + (false_accept_rate is not None) + mean_of_negatives > 1:
        raise typer.BadParameter("give at most one of --precision, --false-accept-rate and --mean-of-negatives")
    for option, share in (("--precision", precision), ("--false-accept-rate", false_accept_rate)):
        if share is not None and not 0 < share < 1:
            raise typer.BadParameter(f"{option} is a share between 0 and 1, such as 0.95 for 95 %, not {share:g}")
    if mean_of_negatives:
        return {"rule": "mean_of_negatives"}
    if false_accept_rate is not None:
        return {"rule": "false_accept_rate", "value": false_accept_rate}
    return {"rule": "precision", "value": 0.95 if precision is None else precision}


def _rows(path: Path, columns: tuple[str, str]) -> list[tuple[str, str]]:
    """The two columns of a CSV file with a header; the second may be empty.

    Raises:
        Failure: the file cannot be read, lacks a column, or has no row.
    """
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            reader = csv.DictReader(file)
            if not set(columns) <= set(reader.fieldnames or ()):
                raise Failure(f"{path} needs the columns {','.join(columns)}.")
            rows = [((row[columns[0]] or "").strip(), (row[columns[1]] or "").strip()) for row in reader]
    except OSError as error:
        raise Failure(f"{path} cannot be read: {error.strerror}.") from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise Failure(f"{path} is not a CSV file in UTF-8: {error}.") from error
    if not rows:
        raise Failure(f"{path} has no rows.")
    return rows


def _show(report: dict[str, Any]) -> None:
    calibration, measured, held = report["calibration"], report["measurement"], report["measurement"]["cross_validated"]
    for warning in report["warnings"]:
        remark(warning)
    if report["change"] is not None and report["change"]["worse"] is not None:
        remark(f"It would not be stored. {report['change']['worse']}")
    done = "is calibrated" if report["stored"] else "would be calibrated"
    say(
        f"The map {report['map']} {done} by {measured['frames']} frames: threshold {number(calibration['threshold'])}, "
        f"margin {number(calibration['margin'])}."
    )
    figures = table("figure", "#value", "#from", "#to", title="Verdicts on frames held out")
    for name in ("precision", "recall", "false_accept_rate"):
        share = held[name]
        figures.add_row(name.replace("_", " "), number(share["value"]), number(share["low"]), number(share["high"]))
    for name, value in (
        ("area under the ROC", measured["auc_roc"]),
        ("area under the PR curve", measured["auc_pr"]),
        ("calibration error", held["reliability"]["ece"]),
        ("Brier score", held["reliability"]["brier"]),
    ):
        figures.add_row(name, number(value), "", "")
    for name in ("known", "strangers"):
        if (kind := (report["change"] or {}).get(name)) is not None:
            figures.add_row(f"error, {name}: before", number(kind["before"]["error"]), "", "")
            figures.add_row(f"error, {name}: after", number(kind["after"]["error"]), "", "")
    show(figures)
    points = table("#threshold", "#precision", "#recall", "#false accepts", title="Thresholds alone, on all frames")
    shown = measured["points"]
    for point in shown[:: max(1, len(shown) // SHOWN_POINTS)]:
        points.add_row(*(number(point[name]) for name in ("threshold", "precision", "recall", "false_accept_rate")))
    show(points)
    remark(
        "The first table has what the map would answer, by threshold, margin and verification; the second what each "
        "threshold alone lets through by two stages, so that its recall is another one."
    )
