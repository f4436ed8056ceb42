# SyntheT-Less with Blender; docs/docker.md tells how to use it.
ARG BASE=debian:12-slim
# hadolint ignore=DL3006
FROM ${BASE}

# Python 3.11, for which Blender is built as a module, and the shared libraries that Blender needs (`make system-libraries`).
# hadolint ignore=DL3008
RUN apt-get update \
    && apt-get install -y --no-install-recommends \
        python3.11 python3.11-venv \
        libx11-6 libxrender1 libxxf86vm1 libxfixes3 libxi6 libxkbcommon0 libsm6 libice6 libgl1 libegl1 libgomp1 \
    && rm -rf /var/lib/apt/lists/*

COPY . /opt/synthetless
WORKDIR /opt/synthetless
RUN python3.11 -m venv /opt/venv \
    && /opt/venv/bin/pip install --no-cache-dir --disable-pip-version-check -c constraints.txt '.[blender,preview]'

# The container may run as any user, who has no home in it; NVIDIA's tools mount what OptiX needs as "graphics".
ENV PATH=/opt/venv/bin:$PATH \
    HOME=/tmp \
    NVIDIA_DRIVER_CAPABILITIES=compute,graphics,utility
WORKDIR /data
ENTRYPOINT ["synthetless"]
CMD ["--help"]
