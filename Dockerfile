# The package on Debian 12, set up by scripts/setup-env.
#
#     docker build -t mitsuba-fspt .
#     docker run --rm -v "$PWD:/data" mitsuba-fspt render /data/scene.xml -o /data/image.exr
#
# On a GPU: the driver's OptiX comes with the capability `graphics`, which NVIDIA's runtime leaves out by default.
#
#     docker run --rm --gpus all -v "$PWD:/data" mitsuba-fspt doctor
FROM debian:12-slim

ENV NVIDIA_VISIBLE_DEVICES=all \
    NVIDIA_DRIVER_CAPABILITIES=compute,utility,graphics

WORKDIR /opt/mitsuba_fspt
COPY . .
RUN scripts/setup-env llvm,plot,mesh,tissue,formats,notebook,view,cluster,reduce \
    && rm -rf /var/lib/apt/lists/* /root/.cache

ENV PATH=/opt/mitsuba_fspt/.venv/bin:$PATH
WORKDIR /data
ENTRYPOINT ["fspt"]
CMD ["--help"]
