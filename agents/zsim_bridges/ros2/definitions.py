"""The texts of the messages and services that rosbags does not bring."""

CLUSTER_STATE = """\
# Where a formation is, by the estimates of its drones, and where it is to be.
# names are the 4n cluster variables of n drones, in the order of value and desired [m, rad] and of desired_rate
# [m/s, rad/s].
std_msgs/Header header
# idle, taking_off, assembling, engaged, landing, held
string phase
string[] drones
string[] names
float64[] value
float64[] desired
float64[] desired_rate
# the trajectory's own time [s], NaN where none runs
float64 trajectory_time
# distance to a singularity, in the measure of the cluster space
float64 margin
# why it waits or is held
string reason
"""

NAVDATA = """\
# What ardrone_autonomy's Navdata tells, in its units and signs (x forward, y left, z up), with names as ROS 2 wants
# them. What nobody has told yet is NaN, or 0 where it is a whole number.
std_msgs/Header header
# [%]
float32 battery_percent
# 2 landed, 3 flying, 4 hovering, 6 taking off, 8 landing, 0 emergency
uint32 state
# in the axes of the magnetometer [uT]
float32 mag_x
float32 mag_y
float32 mag_z
# [Pa]
int32 pressure
# roll, pitch (nose down), yaw (counter-clockwise, from east) by the estimate [deg]
float32 rot_x
float32 rot_y
float32 rot_z
# by sonar [mm]
int32 altd
# by optical flow [mm/s]
float32 vx
float32 vy
float32 vz
# [g]
float32 ax
float32 ay
float32 az
# since the start [us]
float32 tm
"""

MESSAGES = {"zsim_msgs/msg/ClusterState": CLUSTER_STATE, "zsim_msgs/msg/Navdata": NAVDATA}
SERVICES = {  # requests and responses
    "std_srvs/srv/Trigger": ("", "bool success\nstring message\n"),
    "std_srvs/srv/SetBool": ("bool data\n", "bool success\nstring message\n"),
}
SERVICE_EVENT_INFO = """\
uint8 event_type
builtin_interfaces/Time stamp
uint8[16] client_gid
int64 sequence_number
"""
"""Of service_msgs; its `char[16]` counts as uint8 in type hashes."""

PACKAGE = {  # a ROS 2 package that makes ROS know MESSAGES
    "package.xml": """\
<?xml version="1.0"?>
<package format="3">
  <name>zsim_msgs</name>
  <version>1.0.0</version>
  <description>Messages of zsim's ROS 2 side</description>
  <maintainer email="nobody@example.org">zsim</maintainer>
  <license>Apache-2.0</license>
  <buildtool_depend>ament_cmake</buildtool_depend>
  <buildtool_depend>rosidl_default_generators</buildtool_depend>
  <depend>std_msgs</depend>
  <exec_depend>rosidl_default_runtime</exec_depend>
  <member_of_group>rosidl_interface_packages</member_of_group>
  <export><build_type>ament_cmake</build_type></export>
</package>
""",
    "CMakeLists.txt": """\
cmake_minimum_required(VERSION 3.8)
project(zsim_msgs)
find_package(ament_cmake REQUIRED)
find_package(rosidl_default_generators REQUIRED)
find_package(std_msgs REQUIRED)
rosidl_generate_interfaces(${PROJECT_NAME} "msg/ClusterState.msg" "msg/Navdata.msg" DEPENDENCIES std_msgs)
ament_package()
""",
    "msg/ClusterState.msg": CLUSTER_STATE,
    "msg/Navdata.msg": NAVDATA,
}
