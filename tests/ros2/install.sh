#!/bin/sh
# ROS 2 Kilted from PyPI with event_camera_msgs, in a virtual environment of its own: tests/ros2/install.sh PYTHON FOLDER
# x86-64 Linux, Python 3.11 to 3.13, gcc. If a step fails, FOLDER.why names it, and the tests that need ROS 2 are skipped.
set -eu
here=$(dirname "$0") python=$1 folder=$2
rm -rf "$folder" "$folder.why"
step() {
    name=$1
    shift
    "$@" > "$folder.log" 2>&1 || {
        echo "$name failed: $(tail -n 1 "$folder.log")" | tee "$folder.why"
        exit 1
    }
}
step "python -m venv" "$python" -m venv "$folder"
step "pip install ros-rclpy" "$folder/bin/python" -m pip install --quiet --disable-pip-version-check -r "$here/requirements.txt"
step "compiling event_camera_msgs" "$folder/bin/python" "$here/make_messages.py"
rm -f "$folder.log"
touch "$folder/ready"
