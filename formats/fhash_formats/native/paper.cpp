#include "volume.hpp"

namespace fhash {

bool read_network(fhash_file&, const Variable&, double, const Lattice&, const Buffer&, double*,
                  fhash_error& error) {
    return fail(error, FHASH_ERROR_UNSUPPORTED, "the profile paper is not read yet");
}

bool read_plain(fhash_file&, const Variable&, int64_t, const Lattice&, Frame&,
                fhash_error& error) {
    return fail(error, FHASH_ERROR_UNSUPPORTED, "plain files are not read yet");
}

}  // namespace fhash
