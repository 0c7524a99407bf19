# docker build -t cvtgs .
# docker run --rm -u "$(id -u):$(id -g)" -v "$PWD:/data" cvtgs simplify scene.ply small.ply --rho 0.01
FROM python:3.12-slim

# OpenMP, with which numba renders several images at a time.
RUN apt-get update && apt-get install -y --no-install-recommends libgomp1 \
    && rm -rf /var/lib/apt/lists/*

WORKDIR /src
COPY pyproject.toml constraints.txt README.md LICENSE ./
COPY src src
RUN python -m pip install --no-cache-dir --extra-index-url https://download.pytorch.org/whl/cpu \
        -c constraints.txt ".[plots]" \
    && rm -rf /src

# Any user may run it: caches of numba and matplotlib and the measured speed of the machine.
ENV HOME=/tmp
WORKDIR /data
ENTRYPOINT ["cvtgs"]
CMD ["--help"]
