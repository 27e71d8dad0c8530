# pyright: reportMissingImports=false
"""A node as users of ardrone_autonomy write it: takes off, climbs to 1.6 m by the altitude in navdata, hovers, lands.

Knows nothing of zsim. Run in the drone's namespace: ROS_NAMESPACE=drone1 python3 ros1_climb.py
"""

import json

import rospy
from ardrone_autonomy.msg import Navdata
from geometry_msgs.msg import Twist, Vector3Stamped
from nav_msgs.msg import Odometry
from sensor_msgs.msg import Imu, NavSatFix
from std_msgs.msg import Empty

LANDED, FLYING, HOVERING = 2, 3, 4
ALTITUDE_MM = 1600


class Climb:
    """One flight."""

    def __init__(self):
        self.navdata = Navdata()
        self.count = 0
        self.states = []
        rospy.Subscriber("ardrone/navdata", Navdata, self.on_navdata, queue_size=1, tcp_nodelay=True)
        self.cmd_vel = rospy.Publisher("cmd_vel", Twist, queue_size=1)
        self.takeoff = rospy.Publisher("ardrone/takeoff", Empty, queue_size=1)
        self.land = rospy.Publisher("ardrone/land", Empty, queue_size=1)

    def on_navdata(self, navdata):
        self.navdata = navdata
        self.count += 1
        if not self.states or self.states[-1] != navdata.state:
            self.states.append(navdata.state)

    def until(self, true, act=lambda: None):
        rate = rospy.Rate(20)
        while not rospy.is_shutdown() and not (self.count and true(self.navdata)):
            act()
            rate.sleep()

    def fly(self):
        self.until(lambda navdata: navdata.state == LANDED and self.takeoff.get_num_connections())
        self.takeoff.publish(Empty())
        self.until(lambda navdata: navdata.state == HOVERING)
        up = Twist()
        up.linear.z = 0.6
        self.until(lambda navdata: navdata.altd > ALTITUDE_MM, lambda: self.cmd_vel.publish(up))
        self.cmd_vel.publish(Twist())
        self.until(lambda navdata: navdata.state == HOVERING)
        seen = {
            "altd": self.navdata.altd,
            "rotZ": self.navdata.rotZ,
            "imu": rospy.wait_for_message("ardrone/imu", Imu).linear_acceleration.z,
            "mag": rospy.wait_for_message("ardrone/mag", Vector3Stamped).vector.z,
            "odometry": rospy.wait_for_message("ardrone/odometry", Odometry).child_frame_id,
            "fix": rospy.wait_for_message("fix", NavSatFix).position_covariance[0],
            "ground_truth": rospy.wait_for_message("ground_truth/state", Odometry).pose.pose.position.z,
        }
        self.land.publish(Empty())
        self.until(lambda navdata: navdata.state == LANDED)
        print(json.dumps({"states": self.states, "count": self.count, **seen}), flush=True)


rospy.init_node("climb")
Climb().fly()
