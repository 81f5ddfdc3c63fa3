# SPDX-License-Identifier: Apache-2.0
# What rosidl needs besides its own rules when it comes from PyPI wheels; nothing happens with a distribution's ROS.

# The wheels' imported targets name include folders of the machine they were built on; CMake refuses those.
function(sf_drop_missing_include_directories)
  get_property(targets DIRECTORY PROPERTY IMPORTED_TARGETS)
  foreach(target IN LISTS targets)
    get_target_property(folders ${target} INTERFACE_INCLUDE_DIRECTORIES)
    if(folders)
      set(kept "")
      foreach(folder IN LISTS folders)
        if(folder MATCHES "^\\$<" OR EXISTS "${folder}")
          list(APPEND kept "${folder}")
        endif()
      endforeach()
      set_target_properties(${target} PROPERTIES INTERFACE_INCLUDE_DIRECTORIES "${kept}")
    endif()
  endforeach()
endfunction()

# Inside the wheel only Python speaks the messages, so the build leaves out what only C++ nodes use. The
# introspection of C stays: Fast DDS describes the types with it, and refuses a publisher without it.
macro(sf_python_type_supports_only)
  if(DEFINED SKBUILD)
    list(FILTER AMENT_EXTENSIONS_rosidl_generate_idl_interfaces EXCLUDE REGEX "introspection_cpp")
  endif()
endmacro()
