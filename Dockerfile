# dentalsplat with warm kernels, for any user id:
#
#   docker build -t dentalsplat .
#   docker run --rm -u "$(id -u):$(id -g)" -v "$PWD":/data --read-only --tmpfs /tmp dentalsplat \
#       run photos/ -w case
#
# docs/container.md says more.
FROM python:3.11-slim-bookworm

# what the wheels expect of the system (tools/system-packages)
RUN apt-get update \
    && apt-get install -y --no-install-recommends libusb-1.0-0 libgl1 libopengl0 libegl1 libx11-6 libgomp1 \
    && rm -rf /var/lib/apt/lists/*

WORKDIR /src
COPY setup.cfg pyproject.toml constraints.txt README.md LICENSE ./
COPY dentalsplat dentalsplat
COPY pipeline pipeline
COPY stages stages
COPY configs configs
COPY tools/requirements.py tools/
# Bytecode is made here: later nobody may write beside the program.
RUN python tools/requirements.py batch dicom > requirements.txt \
    && pip install --no-cache-dir --compile --constraint constraints.txt --requirement requirements.txt \
    && pip install --no-cache-dir --compile --constraint constraints.txt --no-deps . \
    && rm -rf /src

# The kernels, compiled beside the program, where every user may read them. They are for the kind of
# processor of this machine: on another one a run compiles its own, into /tmp.
RUN pipeline warmup && chmod -R a+rX /usr/local/lib/python3.11/site-packages/pipeline

# A user id without an account has no home: what libraries keep there goes to /tmp.
ENV HOME=/tmp MPLCONFIGDIR=/tmp/matplotlib PYTHONDONTWRITEBYTECODE=1
WORKDIR /data
USER 65534:65534
ENTRYPOINT ["pipeline"]
CMD ["--help"]
