// Reads a region of the first variable of a .fhz file, with owners for what C leaves open.
#include <cmath>
#include <iostream>
#include <memory>
#include <stdexcept>
#include <vector>

#include <fhash.h>

int main(int count, char** words) try {
    if (count != 2) throw std::invalid_argument("usage: read_region RUN.fhz");
    fhash_error error;
    const auto check = [&](int32_t status) {
        if (status != FHASH_OK) throw std::runtime_error(error.text);
    };
    const std::unique_ptr<fhash_context, decltype(&fhash_context_destroy)> context(
        fhash_context_create(0, 2), fhash_context_destroy);
    fhash_file* opened = nullptr;
    check(fhash_open_path(context.get(), words[1], &opened, &error));
    const std::unique_ptr<fhash_file, decltype(&fhash_close)> file(opened, fhash_close);

    fhash_variable variable;
    variable.size = sizeof variable;
    check(fhash_variable_get(file.get(), 0, &variable, &error));
    const int64_t* const n = variable.shape;
    std::cout << variable.name << " (" << n[0] << ", " << n[1] << ", " << n[2] << ", " << n[3]
              << ") " << variable.units << "\n";

    // the first half of each axis, at the middle of the steps, which may lie between two
    const int64_t region[] = {0, (n[1] + 1) / 2, 0, (n[2] + 1) / 2, 0, (n[3] + 1) / 2};
    std::vector<float> values(region[1] * region[3] * region[5]);
    check(fhash_read(file.get(), 0, (n[0] - 1) / 2.0, region, 0, FHASH_FLOAT32, values.data(),
                     &error));
    double sum = 0, counted = 0;  // missing values, and those outside the features, are NaN
    for (const float value : values) {
        if (!std::isnan(value)) sum += value, counted++;
    }
    std::cout.precision(12);
    std::cout << "last " << values.back() << " mean " << sum / counted << " of " << counted << "\n";
} catch (const std::exception& error) {
    std::cerr << error.what() << "\n";
    return 1;
}
