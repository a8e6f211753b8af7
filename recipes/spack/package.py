# The owner puts in the address, the sha256 and the licence of a release.
from spack.package import *
from spack_repo.builtin.build_systems.python import PythonPackage


class PyFhash(PythonPackage):
    """A codec for time-varying volumes: feature-based tesseract grids (F-Hash), random access."""

    version("0.1.0")

    depends_on("c", type="build")
    depends_on("cxx", type="build")
    depends_on("python@3.11:", type=("build", "run"))
    depends_on("py-setuptools@77:", type="build")
    with default_args(type=("build", "run")):
        depends_on("py-numpy@2.0:")
        depends_on("py-cffi@1.17:")
        depends_on("py-zarr@3.1.3:")
        depends_on("py-numcodecs@0.16:")
        depends_on("py-h5py@3.12:")
        depends_on("py-h5netcdf@1.4:")
        depends_on("py-xarray@2025.9.1:")
        depends_on("py-click@8.2:")
        depends_on("py-pillow@11:")
