# The library in C and C++: handmap/handmap.h, and the headers that it is made of.
include(CMakePackageConfigHelpers)
include(GNUInstallDirs)

if(NOT CMAKE_BUILD_TYPE AND NOT CMAKE_CONFIGURATION_TYPES)
  set(CMAKE_BUILD_TYPE Release)
endif()

# Static, unless BUILD_SHARED_LIBS says otherwise.
add_library(handmap library/handmap.cpp)
add_library(handmap::handmap ALIAS handmap)
set_target_properties(handmap PROPERTIES
  VERSION ${PROJECT_VERSION} SOVERSION ${PROJECT_VERSION_MAJOR}.${PROJECT_VERSION_MINOR}
  CXX_VISIBILITY_PRESET hidden VISIBILITY_INLINES_HIDDEN ON POSITION_INDEPENDENT_CODE ON)
target_include_directories(handmap PUBLIC
  "$<BUILD_INTERFACE:${CMAKE_CURRENT_SOURCE_DIR}/include>"
  "$<INSTALL_INTERFACE:${CMAKE_INSTALL_INCLUDEDIR}>")
target_compile_features(handmap PUBLIC cxx_std_17)
# Programs that include the C++ headers read files of the same version, and round as the library does.
target_compile_definitions(handmap PUBLIC HANDMAP_VERSION="${PROJECT_VERSION}")
if(NOT MSVC)
  target_compile_options(handmap PUBLIC -ffp-contract=off PRIVATE -Wall -Wextra)
endif()

install(TARGETS handmap EXPORT handmap)
install(DIRECTORY include/handmap DESTINATION "${CMAKE_INSTALL_INCLUDEDIR}")
set(PACKAGE_FOLDER "${CMAKE_INSTALL_LIBDIR}/cmake/handmap")
install(EXPORT handmap NAMESPACE handmap:: FILE handmap-config.cmake DESTINATION "${PACKAGE_FOLDER}")
write_basic_package_version_file("${CMAKE_CURRENT_BINARY_DIR}/handmap-config-version.cmake"
                                 COMPATIBILITY SameMinorVersion)
install(FILES "${CMAKE_CURRENT_BINARY_DIR}/handmap-config-version.cmake"
        DESTINATION "${PACKAGE_FOLDER}")
