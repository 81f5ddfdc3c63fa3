# SPDX-License-Identifier: Apache-2.0
# sf_native_package([OPTIONS flag...]): the Python package in this folder with its compiled module _native, built from
# csrc/*.cpp. The target is called ${PROJECT_NAME}_native.
function(sf_native_package)
  find_package(ament_cmake_python REQUIRED)
  ament_get_python_install_dir(site_packages)
  cmake_parse_arguments(arg "" "" "OPTIONS" ${ARGN})
  if(NOT CMAKE_BUILD_TYPE AND NOT CMAKE_CONFIGURATION_TYPES)
    set(CMAKE_BUILD_TYPE Release CACHE STRING "" FORCE)
  endif()
  # nanobind asks for Python, ament for Python3: both must be the same interpreter.
  find_package(Python3 REQUIRED COMPONENTS Interpreter Development.Module)
  set(Python_EXECUTABLE "${Python3_EXECUTABLE}")
  find_package(Python REQUIRED COMPONENTS Interpreter Development.Module)
  execute_process(COMMAND "${Python_EXECUTABLE}" -m nanobind --cmake_dir
    OUTPUT_VARIABLE nanobind_ROOT OUTPUT_STRIP_TRAILING_WHITESPACE ERROR_QUIET)
  find_package(nanobind CONFIG REQUIRED)
  # In the source tree, then where sf_interfaces is installed.
  find_path(SF_NATIVE_INCLUDE sf_native/arrays.hpp REQUIRED NO_DEFAULT_PATH
    PATHS "${CMAKE_CURRENT_FUNCTION_LIST_DIR}/../include"
          "${CMAKE_CURRENT_FUNCTION_LIST_DIR}/../../../include/sf_interfaces")

  # Portable machine code: a wheel must run on any x86-64 or arm64 machine, so no -march=native; sf_native/simd.hpp
  # picks wider vectors at run time. All of them, and the numpy definitions, round alike: no contraction to fused
  # multiply-add. Vectors are passed between inlined functions only, where no calling convention matters (-Wno-psabi).
  file(GLOB sources CONFIGURE_DEPENDS csrc/*.cpp)
  nanobind_add_module(${PROJECT_NAME}_native NB_STATIC ${sources})
  set_target_properties(${PROJECT_NAME}_native PROPERTIES OUTPUT_NAME _native)
  target_compile_features(${PROJECT_NAME}_native PRIVATE cxx_std_17)
  target_include_directories(${PROJECT_NAME}_native PRIVATE "${SF_NATIVE_INCLUDE}")
  set(flags -O3 -Wall -Wextra -Wno-psabi -ffp-contract=off ${arg_OPTIONS})
  target_compile_options(${PROJECT_NAME}_native PRIVATE "$<$<COMPILE_LANGUAGE:CXX>:${flags}>")

  install(TARGETS ${PROJECT_NAME}_native LIBRARY DESTINATION "${site_packages}/${PROJECT_NAME}")
  install(DIRECTORY . DESTINATION "${site_packages}/${PROJECT_NAME}" FILES_MATCHING
    PATTERN "*.py" PATTERN "py.typed" PATTERN "csrc" EXCLUDE)
endfunction()
