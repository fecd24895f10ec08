# The compiled part of the Python package handmap_core.
find_package(Python 3.11 REQUIRED COMPONENTS Interpreter Development.Module
             OPTIONAL_COMPONENTS Development.SABIModule)
execute_process(COMMAND "${Python_EXECUTABLE}" -m nanobind --cmake_dir
                OUTPUT_STRIP_TRAILING_WHITESPACE OUTPUT_VARIABLE nanobind_ROOT)
find_package(nanobind CONFIG REQUIRED)

# The stable ABI from Python 3.12 on; NOMINSIZE compiles for speed.
file(GLOB SOURCES CONFIGURE_DEPENDS "${CMAKE_CURRENT_SOURCE_DIR}/src/*.cpp")
nanobind_add_module(_core STABLE_ABI NB_STATIC NOMINSIZE NB_DOMAIN handmap_core ${SOURCES})
target_include_directories(_core PRIVATE "${CMAKE_CURRENT_SOURCE_DIR}/include")
# One file alone knows the fingerprint, so that a change in another does not compile them all.
set_source_files_properties(src/module.cpp PROPERTIES
                            COMPILE_DEFINITIONS HANDMAP_SOURCES="${HANDMAP_SOURCES}")
if(NOT MSVC)
  # Release has -O3. Without contraction, one machine rounds as the other.
  target_compile_options(_core PRIVATE -ffp-contract=off -Wall -Wextra)
endif()
install(TARGETS _core LIBRARY DESTINATION handmap_core)
