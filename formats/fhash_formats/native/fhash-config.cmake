# find_package(fhash) gives the target fhash::fhash, of a system's installation or of the Python
# package, whose folder has all files: the folder is that of `fhash_formats.native`.
foreach(folder "${CMAKE_CURRENT_LIST_DIR}" "${CMAKE_CURRENT_LIST_DIR}/../..")
    file(GLOB fhash_LIBRARY "${folder}/libfhash.so" "${folder}/libfhash.dylib")
    if(fhash_LIBRARY)
        break()
    endif()
endforeach()
find_path(fhash_INCLUDE_DIR fhash.h NO_DEFAULT_PATH PATHS "${CMAKE_CURRENT_LIST_DIR}"
    "${CMAKE_CURRENT_LIST_DIR}/../../../include" "${CMAKE_CURRENT_LIST_DIR}/../../../../include")
if(NOT fhash_LIBRARY OR NOT fhash_INCLUDE_DIR)
    set(fhash_FOUND FALSE)
    set(fhash_NOT_FOUND_MESSAGE "no libfhash or fhash.h beside ${CMAKE_CURRENT_LIST_DIR}")
elseif(NOT TARGET fhash::fhash)
    add_library(fhash::fhash SHARED IMPORTED)
    set_target_properties(fhash::fhash PROPERTIES IMPORTED_LOCATION "${fhash_LIBRARY}"
        INTERFACE_INCLUDE_DIRECTORIES "${fhash_INCLUDE_DIR}")
endif()
