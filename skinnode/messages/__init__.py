"""ROS 2 messages for a hand: standard messages where they exist, and ``skinnode_msgs`` for the rest.

``definitions`` contains the message definitions that rosbags does not include. ``typestore`` encodes and
decodes messages as CDR with rosbags, an optional dependency. Every other module converts one kind of host
data: ``can_frames`` (raw CAN frames), ``fields`` (displacement fields), ``contacts`` (contacts and their
wrenches), ``health`` (health and events), and ``poses`` (poses of patches and links). ``full_field`` and
``health_report`` convert fields and health losslessly, for :mod:`skinnode.remote`. ``topics`` names topics
and coordinate frames. ``message_package`` and ``ros2_canopen`` write ROS 2 packages: the definitions of
``skinnode_msgs``, and the buses of a hand for ros2_canopen.

==============================  =================================================================
data                            message
==============================  =================================================================
classic CAN frame               ``can_msgs/Frame``, as in ros_canopen and ros2_socketcan
CAN FD frame                    ``ros2_socketcan_msgs/FdFrame``
displacement field              ``sensor_msgs/PointCloud2`` and ``skinnode_msgs/FieldInfo``
field, lossless                 ``skinnode_msgs/Field``
contact                         ``geometry_msgs/WrenchStamped`` and ``skinnode_msgs/Contacts``
health of patches and buses     ``diagnostic_msgs/DiagnosticArray``
health, lossless                ``skinnode_msgs/HealthReport``
event                           ``rcl_interfaces/Log``
poses of patches and links      ``tf2_msgs/TFMessage``
line of a recording's journal   ``skinnode_msgs/JournalLine``
==============================  =================================================================
"""
