# The state machines as extension modules beside their sources; Python prefers them. What is written
# in Python stays the one source: mypy's compiler makes C of it.

enable_language(C)

set(machines_dir "${CMAKE_CURRENT_BINARY_DIR}/machines")
execute_process(
  COMMAND "${Python_EXECUTABLE}" "${CMAKE_CURRENT_LIST_DIR}/compile_machines.py"
          "${CMAKE_CURRENT_SOURCE_DIR}" "${machines_dir}"
  RESULT_VARIABLE result)
if(NOT result EQUAL 0)
  message(FATAL_ERROR "the machines cannot be compiled; what is wrong stands above")
endif()
include("${machines_dir}/modules.cmake") # sets compiled_modules, and what each is made of

foreach(module IN LISTS compiled_modules)
  string(REPLACE "." "/" path "${module}")
  get_filename_component(folder "${path}" DIRECTORY)
  get_filename_component(name "${path}" NAME)
  Python_add_library(${module} MODULE WITH_SOABI ${${module}_sources})
  target_include_directories(${module} PRIVATE ${${module}_includes})
  # Arithmetic as the interpreter does it, which knows no contraction; C that nobody wrote is not
  # worth a warning.
  target_compile_options(${module} PRIVATE -O2 -ffp-contract=off -fwrapv -w)
  set_target_properties(${module} PROPERTIES OUTPUT_NAME "${name}"
    LIBRARY_OUTPUT_DIRECTORY "${machines_dir}/modules/${folder}")
  install(TARGETS ${module} LIBRARY DESTINATION "${folder}")
endforeach()
