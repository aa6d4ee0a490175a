"""Recordings of vision_msgs/Detection2DArray, as releases of ROS define it."""

import numpy as np
from rosbags.typesys import get_types_from_msg

from tests.conversion.recordings import START_NS, Recording

LINE = "=" * 80
DETECTION = f"""{{header}} header
vision_msgs/Detection2D[] detections
{LINE}
MSG: vision_msgs/Detection2D
{{header}} header
vision_msgs/ObjectHypothesisWithPose[] results
vision_msgs/BoundingBox2D bbox
{{more}}
{LINE}
MSG: vision_msgs/BoundingBox2D
{{centre}} center
float64 size_x
float64 size_y
{LINE}
MSG: vision_msgs/ObjectHypothesisWithPose
{{what}}
geometry_msgs/PoseWithCovariance pose
"""
NEW_DETECTION = f"""{DETECTION}{LINE}
MSG: vision_msgs/Pose2D
vision_msgs/Point2D position
float64 theta
{LINE}
MSG: vision_msgs/Point2D
float64 x
float64 y
{LINE}
MSG: vision_msgs/ObjectHypothesis
string class_id
float64 score
"""
NOETIC = DETECTION.format(
    header="Header",
    more="sensor_msgs/Image source_img",
    centre="geometry_msgs/Pose2D",
    what="int64 id\nfloat64 score",
)
FOXY = DETECTION.format(
    header="std_msgs/Header",
    more="bool is_tracking\nstring tracking_id",
    centre="geometry_msgs/Pose2D",
    what="string id\nfloat64 score",
)
HUMBLE = NEW_DETECTION.format(
    header="std_msgs/Header",
    more="string id",
    centre="vision_msgs/Pose2D",
    what="vision_msgs/ObjectHypothesis hypothesis",
)
DETECTIONS = "vision_msgs/msg/Detection2DArray"


def detection_drive(kind, definition, frames):
    """Each frame is a list of boxes (x, y, width, height, {class: score})."""
    drive = Recording(kind)
    drive.store.register(get_types_from_msg(definition, DETECTIONS))
    for n, boxes in enumerate(frames):
        ns = START_NS + n * 10**9
        header = drive.header(ns, "camera")
        detections = [detection(drive, header, *box) for box in boxes]
        message = drive.new(DETECTIONS, header=header, detections=detections)
        drive.add("/detections", message, ns + 7)
    return drive


def detection(drive, header, x, y, width, height, classes):
    fields = drive.store.types["vision_msgs/msg/Detection2D"].__dataclass_fields__
    if "vision_msgs/msg/Pose2D" in drive.store.types:
        point = drive.new("vision_msgs/msg/Point2D", x=x, y=y)
        centre = drive.new("vision_msgs/msg/Pose2D", position=point, theta=0.0)
    else:
        centre = drive.new("geometry_msgs/msg/Pose2D", x=x, y=y, theta=0.0)
    more = {"is_tracking": True, "tracking_id": "t1", "id": "t1"}
    if "source_img" in fields:
        more["source_img"] = drive.new(
            "sensor_msgs/msg/Image",
            header=header,
            height=1,
            width=2,
            encoding="mono8",
            is_bigendian=0,
            step=2,
            data=np.array((3, 4), np.uint8),
        )
    return drive.new(
        "vision_msgs/msg/Detection2D",
        header=header,
        results=[hypothesis(drive, name, score) for name, score in classes.items()],
        bbox=drive.new("vision_msgs/msg/BoundingBox2D", center=centre, size_x=width, size_y=height),
        **{name: value for name, value in more.items() if name in fields},
    )


def hypothesis(drive, name, score):
    type_ = "vision_msgs/msg/ObjectHypothesisWithPose"
    pose = drive.new(
        "geometry_msgs/msg/PoseWithCovariance", pose=drive.pose(0, 0, 0), covariance=np.zeros(36)
    )
    if "vision_msgs/msg/ObjectHypothesis" in drive.store.types:
        inner = drive.new("vision_msgs/msg/ObjectHypothesis", class_id=name, score=score)
        return drive.new(type_, hypothesis=inner, pose=pose)
    return drive.new(type_, id=name, score=score, pose=pose)
