// The module's shell: an empty Python module, so that the library is a legal extension, and the
// ABI number that the loader checks.
//
// The rules of fhash_formats/native/core.hpp hold for all sources of this folder, too.
#include <Python.h>

#include "core.hpp"

// Raise it whenever an exported signature or its meaning changes; native/__init__.py holds the same
// number.
constexpr std::int64_t FHASH_CODEC_ABI = 5;

FHASH_EXPORT std::int64_t fhash_codec_abi_version() { return FHASH_CODEC_ABI; }

static PyModuleDef module_definition = {
    PyModuleDef_HEAD_INIT, "_codec", nullptr, 0, nullptr, nullptr, nullptr, nullptr, nullptr};

PyMODINIT_FUNC PyInit__codec() { return PyModuleDef_Init(&module_definition); }
