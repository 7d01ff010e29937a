"""The node: rectified images in, stereo_msgs/DisparityImage out."""

import numpy as np
import rclpy
from cv_bridge import CvBridge
from message_filters import ApproximateTimeSynchronizer, Subscriber
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import CameraInfo, Image
from stereo_msgs.msg import DisparityImage

from .network import Network

NEAREST_M = 1.0
"""What `max_disparity` stands for: nearer things have larger disparities."""


class StereoNode(Node):
    """Pairs the cameras' images by their time, and publishes the disparity of the left one."""

    def __init__(self):
        super().__init__("rts2_stereo")
        bundle = self.declare_parameter("bundle", "").value
        slop_s = self.declare_parameter("slop_s", 0.01).value
        self._network = Network(bundle)
        self._bridge = CvBridge()
        self._publisher = self.create_publisher(DisparityImage, "disparity", 1)
        topics = (
            (Image, "left/image_rect_color"),
            (Image, "right/image_rect_color"),
            (CameraInfo, "right/camera_info"),
        )
        given = [
            Subscriber(self, kind, topic, qos_profile=qos_profile_sensor_data)
            for kind, topic in topics
        ]
        # A queue of one pair: what comes while the network runs is dropped, and the next is fresh.
        self._pairs = ApproximateTimeSynchronizer(given, queue_size=1, slop=slop_s)
        self._pairs.registerCallback(self._on_pair)
        width, height = self._network.size
        self.get_logger().info(f"{bundle}: pairs of {width}x{height}")

    def _on_pair(self, left, right, right_info):
        images = (self._bridge.imgmsg_to_cv2(image, "rgb8") for image in (left, right))
        try:
            disparity = self._network.disparity(*images)
        except ValueError as error:
            self.get_logger().error(str(error), throttle_duration_sec=5.0)
            return
        self._publisher.publish(self._message(disparity, left.header, right_info))

    def _message(self, disparity, header, right_info):
        """Depth = f * t / disparity; the right camera's projection tells f, and −f·t."""
        focal_px = right_info.p[0]
        message = DisparityImage()
        message.header = header
        message.image = self._bridge.cv2_to_imgmsg(np.ascontiguousarray(disparity), "32FC1")
        message.image.header = header
        message.f = focal_px
        message.t = -right_info.p[3] / focal_px
        message.max_disparity = message.f * message.t / NEAREST_M
        return message


def main():
    """Runs the node until it is stopped."""
    rclpy.init()
    node = StereoNode()
    try:
        rclpy.spin(node)
    except KeyboardInterrupt:
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()
