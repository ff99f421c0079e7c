# gsopt on a CPU: docker build -f containers/cpu.Dockerfile -t gsopt . && docker run --rm -v "$PWD:/work" gsopt train PHOTOS -m RUN
# torch's CPU builds are much smaller than what the default index gives: name their index in PIP_EXTRA_INDEX_URL.
FROM python:3.11-slim-bookworm AS build
RUN apt-get update && apt-get install -y --no-install-recommends g++ && rm -rf /var/lib/apt/lists/*
COPY . /source
RUN pip wheel --no-cache-dir --no-deps -w /wheels /source

FROM python:3.11-slim-bookworm AS gsopt
ARG PIP_EXTRA_INDEX_URL
COPY constraints.txt /wheels/
RUN --mount=type=bind,from=build,source=/wheels,target=/built \
    pip install --no-cache-dir --constraint /wheels/constraints.txt "$(ls /built/*.whl)[sfm,spz,viewer,video]"
RUN useradd --create-home artist
USER artist
WORKDIR /work
ENTRYPOINT ["gsopt"]

# docker build --target check: trains the demo, and fails when it ends without a report.
FROM gsopt AS check
RUN gsopt demo -m /tmp/demo && test -s /tmp/demo/report.html

FROM gsopt
