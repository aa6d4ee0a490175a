"""Recordings of messages as sources: which sequences they become, and how."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray

from conversion.messages.blocks import read_blocks
from conversion.messages.lidars import choose_lidar, place_lidar
from conversion.messages.parts import Part, choose_stamps, divide
from conversion.messages.pose_files import PoseFile, poses_at_scans, read_pose_file
from conversion.messages.poses import FoundPoses, PoseRequest, find_poses, pose_topics
from conversion.messages.recordings import Recording
from conversion.messages.survey import Survey, choose_scan_topics, make_survey
from conversion.messages.velocities import choose_velocity_topic
from conversion.options import Options
from conversion.plan import Arrays, SequencePlan
from semantic2d_dataset.errors import RecordingError
from semantic2d_dataset.format.sequence import SequenceHeader, slug
from semantic2d_dataset.scene.lidars import LidarSpec

_POSE_FILES = (".txt", ".tum", ".csv", ".poses")
_STREAMS_BEFORE_AND_AFTER_NS = 1_000_000_000


class MessageSource:
    """A bag or a log as a `conversion.plan.Source`.

    Every scan topic becomes a sequence; where its beams change or its stamps go backward, a
    sequence ends and another begins.

    Parameters
    ----------
    recording
        Open for reading; leaving this context closes it.
    """

    def __init__(self, recording: Recording) -> None:
        self.recording = recording
        self.path: Path = recording.path
        self.kind = recording.kind
        self.versions: Mapping[str, str] = recording.versions

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.recording.__exit__(*error)

    def files(self) -> Sequence[Path]:
        """Return the files of the recording."""
        return self.recording.files()

    def plans(self, options: Options) -> tuple[SequencePlan, ...]:
        """Read the recording once, and decide how to convert it.

        Raises
        ------
        RecordingError
            If it cannot be converted, or not in this way.
        InvalidInputError
            If an option names nothing known.
        """
        recording = self.recording
        topics = choose_scan_topics(recording, options.scan_topics)
        velocity = choose_velocity_topic(recording, options.velocity)
        recording.streams(options.streams, 0, 0)  # a wrong name is told before anything is read
        file = read_pose_file(Path(options.poses)) if _names_a_file(options.poses) else None
        poses = () if file is not None else pose_topics(recording, options.poses)
        survey = make_survey(recording, topics, poses, velocity)
        stamps, stamps_notice = choose_stamps(recording.path, survey, options.stamps)
        parts = [part for log in survey.scans for part in divide(recording.path, log, stamps)]
        planners = [_Planner(recording, survey, options, stamps, part, file) for part in parts]
        names = _names(self.path, options, planners)
        notices = (*recording.notices, *stamps_notice)
        return tuple(
            planner.plan(name, notices) for planner, name in zip(planners, names, strict=True)
        )


@dataclass(frozen=True)
class _Planner:
    """What decides about one part."""

    recording: Recording
    survey: Survey
    options: Options
    stamps: str
    part: Part
    file: PoseFile | None

    @property
    def chosen_lidar(self) -> tuple[LidarSpec, str]:
        part, path = self.part, self.recording.path
        return choose_lidar(path, part.log.topic, part.run.beams, self.options.lidar)

    def plan(self, name: tuple[str, str], notices: tuple[str, ...]) -> SequencePlan:
        """Choose mount and poses, and say what will be read."""
        part, options = self.part, self.options
        lidar, lidar_how = self.chosen_lidar
        base = _base_frame(self.recording.path, self.survey, part, options.base_frame)
        frame = part.run.beams.frame
        in_tf = None if base is None else self.survey.transforms.mount(base, frame)
        lidar, mount_how = place_lidar(lidar, options.mount, in_tf)
        poses = self._poses(base, lidar)
        keep = poses.known if options.drop_without_pose else np.ones(len(part), np.bool_)
        if not keep.any():
            why = "; ".join(poses.notices) or f"{poses.source} covers none"
            raise RecordingError(
                self.recording.path,
                f"{part.log.topic.name}: no scan has a pose to be kept for: {why}",
            )
        guesses = (f"lidar {lidar_how}", f"mount {mount_how}", *poses.notices, *part.notices)
        environment, recording = name
        return SequencePlan(
            header=SequenceHeader(
                environment=environment,
                recording=recording,
                lidar=lidar,
                license=options.license,
                stamps_source=self.stamps,
                provenance={"base_frame": base},
            ),
            scans_in=len(part),
            scans_out=int(keep.sum()),
            scans_with_pose=int(poses.known.sum()),
            duration_s=float(part.stamps_ns[-1] - part.stamps_ns[0]) / 1e9,
            blocks=partial(self._blocks, keep, poses.poses),
            topic=part.log.topic.name,
            frame=frame,
            pose_source=poses.source,
            pose_max_gap_s=poses.max_gap_s,
            notices=(*guesses, *notices),
            reverse_intensities=options.reverse_intensities,
        )

    def _poses(self, base: str | None, lidar: LidarSpec) -> FoundPoses:
        part, options = self.part, self.options
        if self.file is not None:
            return poses_at_scans(
                self.file,
                part.stamps_ns,
                lidar.base_T_lidar,
                of=options.poses_of,
                clock_offset_s=options.clock_offset_s,
                max_gap_s=options.max_gap_s,
            )
        request = PoseRequest(
            options.poses, options.map_frame.strip("/"), options.max_gap_s, self.stamps
        )
        # without a base in tf the chain ends at the lidar, and its mount leads back to the base
        frame = part.run.beams.frame
        target = (frame, lidar.base_T_lidar) if base is None else (base, None)
        return find_poses(
            self.recording.path,
            request,
            part.stamps_ns,
            self.survey.transforms,
            self.survey.poses,
            target,
        )

    def _blocks(self, keep: NDArray[np.bool_], poses: NDArray[np.float64]) -> Iterator[Arrays]:
        part, velocities = self.part, self.survey.velocities
        rows: Arrays = {"scans/stamps_ns": part.stamps_ns, "poses/initial": poses}
        if velocities.topic is not None:
            rows["commands/velocity"] = velocities.at(part.record_ns)
        yield from read_blocks(self.recording, part, keep, rows, self.options)
        yield from self.recording.streams(
            self.options.streams,
            int(part.record_ns[0]) - _STREAMS_BEFORE_AND_AFTER_NS,
            int(part.record_ns[-1]) + _STREAMS_BEFORE_AND_AFTER_NS,
        )


def _base_frame(path: Path, found: Survey, part: Part, named: str | None) -> str | None:
    if named is None:
        return found.transforms.base_of(part.run.beams.frame)
    base = named.strip("/")
    if base not in found.transforms.frames:
        frames = ", ".join(found.transforms.frames) or "none"
        raise RecordingError(path, f"no frame {named!r} in tf; its frames: {frames}")
    return base


def _names(path: Path, options: Options, planners: Sequence[_Planner]) -> list[tuple[str, str]]:
    """Name the environment and the recording of each sequence, so that no two share an id."""
    where = path.resolve()
    environment = _given(options.environment, slug(where.parent.name))
    stem = where.name if where.is_dir() else where.name.split(".")[0] or where.name
    recording = _given(options.recording, slug(stem))
    lidars = [(planner.part.log.topic.name, planner.chosen_lidar[0].name) for planner in planners]
    shared = {name for topic, name in lidars if any(n == name and t != topic for t, n in lidars)}
    names = []
    for planner, (topic, lidar) in zip(planners, lidars, strict=True):
        name = f"{recording}-{slug(topic)}" if lidar in shared else recording
        if planner.part.count > 1:
            name += f"-part-{planner.part.number}"
        names.append((environment, name))
    return names


def _names_a_file(poses: str) -> bool:
    """Tell a pose file from a topic: it exists, or has the suffix of a file."""
    return Path(poses).is_file() or Path(poses).suffix.lower() in _POSE_FILES


def _given(value: str | None, default: str) -> str:
    """Return what was given, even if it is empty: the header refuses that."""
    return default if value is None else value
