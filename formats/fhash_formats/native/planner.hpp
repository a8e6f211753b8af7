// The planner: tiles, transform and step of a series by prices of some of its parts (planner.cpp).
#pragma once

#include <array>

#include "context.hpp"
#include "functions.h"

namespace fhash {

// Plans a series. bases: get the packed basis of each axis that has one of its own, fitted to the
// lines of the task.
bool plan_tile(fhash_context& context, const fhash_plan_task& task, fhash_plan_result& result,
               std::array<Buffer, 4>& bases, fhash_error& error);

}  // namespace fhash
