# One image for the API, the workers, the reconciler and the migration; docker-compose.yml says which runs what.

FROM python:3.12-slim-bookworm AS build
ENV PIP_NO_CACHE_DIR=1 PIP_DISABLE_PIP_VERSION_CHECK=1
WORKDIR /src
RUN python -m venv /opt/mrasfm
# Everything comes as a wheel with a known hash: nothing is compiled, so no compiler is needed in either stage.
COPY requirements-runtime.lock ./
RUN /opt/mrasfm/bin/pip install --require-hashes --only-binary :all: -r requirements-runtime.lock
COPY pyproject.toml README.md LICENSE ./
COPY schemas schemas
COPY mrasfm_engine mrasfm_engine
COPY service service
COPY worker worker
RUN /opt/mrasfm/bin/pip install --no-deps --no-index --no-build-isolation . \
    && /opt/mrasfm/bin/pip uninstall --yes setuptools pip

FROM python:3.12-slim-bookworm
RUN groupadd --gid 10001 mrasfm \
    && useradd --uid 10001 --gid mrasfm --no-create-home --home-dir /data --shell /usr/sbin/nologin mrasfm \
    && install --directory --owner mrasfm --group mrasfm --mode 700 /data /models
COPY --from=build /opt/mrasfm /opt/mrasfm
# `python -m` shall not look for packages in the current folder. Code compiled by numba is kept beside the data: the
# rest of the file system may be read-only.
ENV PATH=/opt/mrasfm/bin:$PATH \
    PYTHONSAFEPATH=1 \
    PYTHONUNBUFFERED=1 \
    MRASFM_DATA_DIR=/data \
    NUMBA_CACHE_DIR=/data/numba
USER mrasfm
WORKDIR /data
CMD ["mrasfm", "--help"]
