# gsopt beside a GPU: docker build -f containers/cuda.Dockerfile -t gsopt-cuda . && docker run --rm --gpus all -v "$PWD:/work" gsopt-cuda
# The default index gives torch with CUDA, which brings the run-time compiler of the kernels: no CUDA toolkit is needed.
FROM python:3.11-slim-bookworm AS build
RUN apt-get update && apt-get install -y --no-install-recommends g++ && rm -rf /var/lib/apt/lists/*
COPY . /source
RUN pip wheel --no-cache-dir --no-deps -w /wheels /source

FROM python:3.11-slim-bookworm AS gsopt
COPY constraints.txt /wheels/
RUN --mount=type=bind,from=build,source=/wheels,target=/built \
    pip install --no-cache-dir --constraint /wheels/constraints.txt "$(ls /built/*.whl)[sfm,spz,viewer,video,sds]"
RUN useradd --create-home artist
USER artist
WORKDIR /work
ENTRYPOINT ["gsopt"]

# docker build --target check: trains the demo, and fails when it ends without a report.
FROM gsopt AS check
RUN gsopt demo -m /tmp/demo && test -s /tmp/demo/report.html

FROM gsopt
