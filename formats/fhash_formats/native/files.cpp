// The reader of files in one unit: each of these sources alone would spend most of its time on the
// same headers. Little time goes into it, so it is compiled at -O1.
#if defined(__GNUC__) && !defined(__clang__)
#pragma GCC optimize("O1")
#endif
#if !defined(__wasm__)
#include "files/arrays.cpp"
#endif
#include "files/chunks.cpp"
#include "files/fhash.cpp"
#include "files/file.cpp"
#include "files/json.cpp"
#include "files/paper.cpp"
#include "files/plain.cpp"
#include "files/reading.cpp"
#include "files/variable.cpp"
#include "files/volume.cpp"
#include "files/zarr.cpp"
#include "files/zip.cpp"
