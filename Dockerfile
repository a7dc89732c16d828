# Five images, each with what it runs and no more: `client` (netem and keygen as well), `aboard` (a
# client that speaks MAVLink), `driver` (one that speaks ROS 2), `page` and `server`. What a lock file
# pins, and our wheel. And `ground`, a robot of ROS 2.
# BASE_IMAGE may be any with Python 3.11 or later and its venv; either builder of Docker will do.
ARG BASE_IMAGE=python:3.12-slim

FROM ${BASE_IMAGE} AS tools
ENV PIP_NO_CACHE_DIR=1 PIP_DISABLE_PIP_VERSION_CHECK=1 \
    INSTALL="/build/bin/pip --python /opt/skytether/bin/python install --quiet --only-binary :all:" \
    TRIM="find /opt/skytether -type d -name tests -prune -exec rm -r {} +"
WORKDIR /source
RUN python3 -m venv /build && python3 -m venv --without-pip /opt/skytether


# What makes the wheel stays behind.
FROM tools AS wheel
COPY locks/setup.lock ./
RUN /build/bin/pip install --quiet --only-binary :all: --require-hashes -r setup.lock
COPY . ./
RUN /build/bin/pip wheel --quiet --no-deps --no-build-isolation --wheel-dir /wheel .


FROM tools AS client-packages
COPY locks/client.lock ./
RUN $INSTALL --require-hashes -r client.lock && $TRIM
COPY --from=wheel /wheel /wheel
RUN $INSTALL --no-deps --no-index /wheel/*.whl


FROM tools AS aboard-packages
COPY locks/mavlink.lock ./
RUN $INSTALL --require-hashes -r mavlink.lock && $TRIM
COPY --from=wheel /wheel /wheel
RUN $INSTALL --no-deps --no-index /wheel/*.whl


FROM tools AS driver-packages
COPY locks/ros2.lock ./
RUN $INSTALL --require-hashes -r ros2.lock && $TRIM
COPY --from=wheel /wheel /wheel
RUN $INSTALL --no-deps --no-index /wheel/*.whl


FROM tools AS page-packages
COPY locks/page.lock ./
RUN $INSTALL --require-hashes -r page.lock && $TRIM
COPY --from=wheel /wheel /wheel
RUN $INSTALL --no-deps --no-index /wheel/*.whl


FROM tools AS server-packages
COPY locks/server.lock ./
RUN $INSTALL --require-hashes -r server.lock && $TRIM
COPY --from=wheel /wheel /wheel
RUN $INSTALL --no-deps --no-index /wheel/*.whl
# The server's kernels; a machine of another kind compiles it anew when it starts.
RUN NUMBA_CACHE_DIR=/opt/skytether/kernels /opt/skytether/bin/python -P -c \
    "import skytether.server.endpoint; from skytether.server.schemes import loading; \
    from skytether.shared.base import kernel; loading.load_all(); kernel.load()"


FROM ${BASE_IMAGE} AS bare
# One thread each: BLAS would start one a core, for matrices that are 40 wide.
ENV PATH=/opt/skytether/bin:$PATH \
    HOME=/tmp \
    LANG=C.UTF-8 \
    PYTHONUNBUFFERED=1 \
    OMP_NUM_THREADS=1 \
    OPENBLAS_NUM_THREADS=1
RUN install --directory --owner 10001 --group 10001 /results /keys /flying
USER 10001:10001
WORKDIR /results
STOPSIGNAL SIGTERM
ENTRYPOINT ["skytether"]
CMD ["--help"]


FROM bare AS client
COPY --from=client-packages /opt/skytether /opt/skytether


FROM bare AS aboard
COPY --from=aboard-packages /opt/skytether /opt/skytether


FROM bare AS driver
COPY --from=driver-packages /opt/skytether /opt/skytether


FROM bare AS page
COPY --from=page-packages /opt/skytether /opt/skytether


FROM bare AS server
ENV NUMBA_CACHE_DIR=/tmp/kernels
COPY --from=server-packages /opt/skytether /opt/skytether
# The compiled kernels move to where they can be written to, or nobody would look at them.
ENTRYPOINT ["/bin/sh", "-c", "cp -r /opt/skytether/kernels /tmp; exec skytether \"$@\"", "skytether"]


# The last stage: a builder that makes all before its target pulls no ROS for the others.
FROM ros:jazzy-ros-base AS ground
RUN apt-get update && apt-get install --yes --no-install-recommends ros-jazzy-rmw-zenoh-cpp ros-jazzy-nav-msgs && \
    rm -r /var/lib/apt/lists/*
ENV RMW_IMPLEMENTATION=rmw_zenoh_cpp HOME=/tmp
USER 10001:10001
