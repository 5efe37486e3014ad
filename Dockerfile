# spadwarp with the CUDA runtime; runs on CPUs, too.
#   docker build -t spadwarp .
#   docker run --gpus all -v "$PWD:/data" spadwarp simulate staircase_15m --photons 1e8 --out out/
FROM nvidia/cuda:12.9.1-runtime-ubuntu24.04

RUN apt-get update \
    && apt-get install --no-install-recommends --yes python3 python3-venv \
    && rm -rf /var/lib/apt/lists/*

COPY pyproject.toml README.md CHANGELOG.md LICENSE NOTICE /source/
COPY configs /source/configs
COPY kernels /source/kernels
COPY spadwarp /source/spadwarp
RUN python3 -m venv /opt/spadwarp \
    && /opt/spadwarp/bin/pip install --no-cache-dir /source/kernels "/source[formats,datasets,view,video,xarray]" \
    && rm -rf /source

# Kernels are compiled once for a device; a volume here keeps them.
ENV PATH=/opt/spadwarp/bin:$PATH WARP_CACHE_PATH=/var/cache/warp
VOLUME /var/cache/warp
WORKDIR /data
ENTRYPOINT ["spadwarp"]
CMD ["--help"]
