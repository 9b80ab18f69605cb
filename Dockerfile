# ROS 2 Jazzy with stavpr_ros, for amd64 and arm64:
#   docker build -t stavpr_ros .
#   docker run --rm --network host --ipc=host -v "$PWD:/data" stavpr_ros \
#       ros2 run stavpr_ros node --ros-args -p map_path:=/data/route.stavpr -r image:=/camera/image_raw
# Two stages: `development` has all dependencies (the devcontainer uses it), `runtime` the build.

# For builds that can be repeated, --build-arg BASE=ros@sha256:DIGEST; the digest is printed by
# `docker buildx imagetools inspect ros:jazzy-ros-base`.
ARG BASE=ros:jazzy-ros-base
FROM ${BASE} AS development

# A package index with CPU builds of torch makes the image several GB smaller.
ARG TORCH_INDEX=""

SHELL ["/bin/bash", "-o", "pipefail", "-c"]
WORKDIR /ros_ws

# Only the manifests and requirements: this layer stays cached while the sources change.
COPY package.xml src/stavpr_ros/
COPY stavpr_msgs/package.xml src/stavpr_ros/stavpr_msgs/
COPY stavpr_fleet/package.xml src/stavpr_ros/stavpr_fleet/
COPY stavpr_slam/package.xml src/stavpr_ros/stavpr_slam/
COPY stavpr_nav/package.xml src/stavpr_ros/stavpr_nav/
COPY requirements/robot.txt src/stavpr_ros/requirements/

# Versions are those of the distribution, which changes them for security fixes only.
# hadolint ignore=DL3008
RUN apt-get update \
    && apt-get install -y --no-install-recommends python3-pip python3-venv \
    && rosdep update --rosdistro "$ROS_DISTRO" \
    && ln -s stavpr_ros/stavpr_{msgs,fleet,slam} src/ \
    && rosdep install --from-paths src --ignore-src -y \
    && rm -rf /var/lib/apt/lists/*

# What apt has no package for: a virtual environment that sees the system's packages.
RUN python3 -m venv --system-site-packages /opt/venv \
    && /opt/venv/bin/pip install --no-cache-dir ${TORCH_INDEX:+--index-url "$TORCH_INDEX"} \
        'torch==2.13.0' \
    && /opt/venv/bin/pip install --no-cache-dir -r src/stavpr_ros/requirements/robot.txt \
    && chown -R 1000:1000 /ros_ws
ENV PATH=/opt/venv/bin:$PATH
# Ubuntu's first user
USER 1000:1000

FROM development AS runtime
COPY --chown=1000:1000 . src/stavpr_ros
RUN . "/opt/ros/$ROS_DISTRO/setup.bash" \
    && python3 -m colcon build
ENTRYPOINT ["/bin/bash", "-c", ". /ros_ws/install/setup.bash && exec \"$@\"", "--"]
CMD ["ros2", "run", "stavpr_ros", "node"]
