# CPU:  docker build -t msgs-slam .
# CUDA: docker build -t msgs-slam:cuda --build-arg DEVICE=cuda .
#
#   docker run --rm -v "$PWD:/data" -v msgs-cache:/cache msgs-slam reconstruct video.mp4
#   docker run --rm --gpus all -v "$PWD:/data" -v msgs-cache:/cache msgs-slam:cuda reconstruct video.mp4
#   docker run --rm --network host -v "$PWD:/data" msgs-slam view video.msgs
ARG PYTHON=3.12
FROM python:${PYTHON}-slim AS build
WORKDIR /src
COPY pyproject.toml README.md LICENSE ./
COPY docs/msgs-slam.1 docs/
COPY msgs_slam msgs_slam
COPY msgs_cli msgs_cli
COPY pipelines pipelines
COPY formats formats
RUN pip wheel --no-cache-dir --no-deps --wheel-dir /wheels .

FROM python:${PYTHON}-slim
ARG DEVICE=cpu
# Triton builds a small launcher for each kernel with the C compiler; without a GPU nothing needs one.
# hadolint ignore=DL3008
RUN if [ "$DEVICE" = cuda ]; then \
        apt-get update && apt-get install -y --no-install-recommends gcc libc6-dev && rm -rf /var/lib/apt/lists/*; \
    fi
COPY --from=build /wheels /wheels
# PyPI's torch for Linux brings CUDA, some gigabytes that a machine without a GPU need not carry.
RUN if [ "$DEVICE" = cpu ]; then \
        pip install --no-cache-dir --index-url https://download.pytorch.org/whl/cpu "torch>=2.6,<2.14"; \
    fi \
    && pip install --no-cache-dir /wheels/msgs_slam-*.whl
RUN useradd --uid 1000 --create-home user && mkdir /data /cache && chown 1000 /data /cache
USER 1000
ENV MSGS_SLAM_CACHE=/cache/models NUMBA_CACHE_DIR=/cache/kernels
WORKDIR /data
ENTRYPOINT ["msgs-slam"]
CMD ["doctor"]
