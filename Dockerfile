# docker build -t signorini_cr .
# docker run --rm -v "$PWD:/work" -w /work --user "$(id -u):$(id -g)" signorini_cr \
#     mpirun -n 2 signorini-cr solve problem.toml --out results
FROM debian:trixie-slim

COPY container/packages.txt /tmp/
RUN apt-get update \
    && xargs apt-get install --yes --no-install-recommends < /tmp/packages.txt \
    && rm -rf /var/lib/apt/lists/* /tmp/packages.txt

# The settings of container/run.
ENV OMP_NUM_THREADS=1 \
    MPLBACKEND=Agg \
    OMPI_MCA_btl=self,sm \
    OMPI_MCA_mpi_yield_when_idle=1 \
    PRTE_MCA_rmaps_default_mapping_policy=:oversubscribe \
    PYTHONPATH=/opt/signorini_cr \
    PATH=/opt/signorini_cr/container/bin:$PATH \
    HOME=/home/user

COPY . /opt/signorini_cr
RUN useradd --create-home user && python3 -m compileall -q /opt/signorini_cr/signorini_cr
USER user
WORKDIR /home/user

# Solve once, so that the compiled forms are there. Open to all, for whoever --user names.
RUN mpirun -n 2 signorini-cr solve /opt/signorini_cr/meshes/s1.toml --levels 2 --out /tmp/s1 \
    && rm -r /tmp/s1 \
    && chmod -R a+rwX /home/user
