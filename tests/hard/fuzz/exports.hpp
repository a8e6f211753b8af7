// What the libraries export, for targets: none declares a function itself, so that a call that no
// longer fits a function does not compile.
#pragma once

#include "../../../fhash_codec/native/codec.h"
#include "../../../fhash_codec/native/network/network.h"
#include "../../../formats/fhash_formats/native/functions.h"
