# The one image that server, netem and client run from: what requirements.lock pins, and our wheel.
# BASE_IMAGE may be any with Python 3.11 or later and its venv; either builder of Docker will do.
ARG BASE_IMAGE=python:3.12-slim

FROM ${BASE_IMAGE} AS build
ENV PIP_NO_CACHE_DIR=1 PIP_DISABLE_PIP_VERSION_CHECK=1
WORKDIR /source
RUN python3 -m venv /build && python3 -m venv --without-pip /opt/skytether

COPY requirements.lock ./
RUN /build/bin/pip --python /opt/skytether/bin/python install --quiet \
        --require-hashes --only-binary :all: -r requirements.lock \
    && find /opt/skytether -type d -name tests -prune -exec rm -r {} +

# What makes the wheel stays behind; it has the version that developers have.
COPY requirements-dev.lock ./
RUN sed -n 's/^\([a-z0-9-]*==[^ ;]*\).*/\1/p' requirements-dev.lock >/build/pins \
    && /build/bin/pip install --quiet --only-binary :all: --constraint /build/pins hatchling

COPY . ./
RUN /build/bin/pip wheel --quiet --no-deps --no-build-isolation --wheel-dir /build/wheel . \
    && /build/bin/pip --python /opt/skytether/bin/python install --quiet \
        --no-deps --no-index /build/wheel/*.whl
# What importing the server compiles; a machine of another kind compiles it anew when it starts.
RUN NUMBA_CACHE_DIR=/opt/skytether/kernels /opt/skytether/bin/python -P -c "import server.endpoint"


FROM ${BASE_IMAGE}
# One thread each: BLAS would start one a core, for matrices that are 40 wide.
ENV PATH=/opt/skytether/bin:$PATH \
    HOME=/tmp \
    LANG=C.UTF-8 \
    PYTHONUNBUFFERED=1 \
    OMP_NUM_THREADS=1 \
    OPENBLAS_NUM_THREADS=1 \
    NUMBA_CACHE_DIR=/tmp/kernels
COPY --from=build /opt/skytether /opt/skytether
RUN install --directory --owner 10001 --group 10001 /results /keys /flying
USER 10001:10001
WORKDIR /results
STOPSIGNAL SIGTERM
# The compiled kernels move to where they can be written to, or nobody would look at them.
ENTRYPOINT ["/bin/sh", "-c", "cp -r /opt/skytether/kernels /tmp; exec skytether \"$@\"", "skytether"]
CMD ["--help"]
