# cavbench, built from the two commands of README.md: `make run` installs and drives the first score, `make test` tests it.
#
#   docker build -t cavbench .                                  # installs; the image has 3 GB
#   docker run --rm -v "$PWD/results:/work/results" cavbench run attack=pgd lanes=3 episodes=20 seeds=0
#   docker build --target develop -t cavbench-develop .         # with what `make test` needs, and a browser
FROM python:3.11-slim-bookworm AS run
# Debian keeps no old versions, so none is pinned.
# hadolint ignore=DL3008
RUN apt-get update \
    && apt-get install -y --no-install-recommends make \
    && rm -rf /var/lib/apt/lists/*
WORKDIR /opt/cavbench
COPY . .
RUN make install
ENV PATH="/opt/cavbench/.venv/bin:$PATH" OMP_NUM_THREADS=1
# The driving engine is compiled once, when the first command runs: here, so that no container pays for it again.
RUN bench run attack=noise lanes=3 density=1 weather=clear episodes=1 seeds=0 reference=false executor=serial out=/tmp/first \
    && rm -rf /tmp/first
WORKDIR /work
ENTRYPOINT ["bench"]
CMD ["--help"]

FROM run AS develop
WORKDIR /opt/cavbench
# Debian keeps no old versions, so none is pinned.
# hadolint ignore=DL3008
RUN apt-get update \
    && apt-get install -y --no-install-recommends git chromium \
    && rm -rf /var/lib/apt/lists/* \
    && make install-dev
ENTRYPOINT []
CMD ["make", "test"]
