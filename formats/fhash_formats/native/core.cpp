// The module itself: an empty Python module, so that the library is a legal extension, and the ABI
// number that the loader checks.
#include <Python.h>

#include "core.hpp"

FHASH_EXPORT std::int64_t fhash_abi_version() { return FHASH_ABI; }

static PyModuleDef module_definition = {
    PyModuleDef_HEAD_INIT, "_core", nullptr, 0, nullptr, nullptr, nullptr, nullptr, nullptr,
};

PyMODINIT_FUNC PyInit__core() { return PyModuleDef_Init(&module_definition); }
