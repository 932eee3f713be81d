# One image for both services; compose says which one a container runs.
FROM python:3.12-slim AS build
WORKDIR /src
COPY pyproject.toml README.md LICENSE ./
COPY common common
COPY sender sender
COPY receiver receiver
COPY simulator simulator
RUN python -m venv /opt/surfacelink && /opt/surfacelink/bin/pip install --no-cache-dir .

FROM python:3.12-slim
COPY --from=build /opt/surfacelink /opt/surfacelink
ENV PATH=/opt/surfacelink/bin:$PATH PYTHONUNBUFFERED=1 MPLCONFIGDIR=/tmp/matplotlib
RUN useradd --system --uid 10001 --home-dir /data --create-home surfacelink
USER surfacelink
WORKDIR /data
VOLUME /data
EXPOSE 8000 8001
CMD ["receiver", "serve", "--host", "0.0.0.0", "--data", "/data"]
