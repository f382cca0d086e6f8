# Objects of kernels, compiled once per instruction set: one binary runs anywhere. No contraction: forward and backward
# must round alike (see simd.h).
set(EXACT -O3 -fno-math-errno -fno-trapping-math -ffp-contract=off -Wno-psabi)

option(GSPARC_PORTABLE "only the kernels that every machine runs: quicker to build, slower to run" OFF)
# For tests/hard_cases/test_sanitizers.py: the same kernels, watched.
option(GSPARC_SANITIZE "build with AddressSanitizer and UndefinedBehaviorSanitizer" OFF)
if(GSPARC_SANITIZE)
  list(REMOVE_ITEM EXACT -O3)
  # Null, alignment and object size are what AddressSanitizer sees too; calls in place of inline checks: with
  # both the build takes a third of the time.
  add_compile_options(-O1 -g1 -fno-omit-frame-pointer -fno-sanitize-recover=all
                      -fsanitize=address,undefined,float-cast-overflow -fno-sanitize=null,alignment,object-size,vptr
                      "SHELL:--param asan-instrumentation-with-call-threshold=0")
  add_link_options(-fsanitize=address,undefined)
endif()

if(CMAKE_SYSTEM_PROCESSOR MATCHES "x86_64|AMD64|amd64" AND NOT GSPARC_PORTABLE)
  set(GSPARC_X86 ON)
endif()
set(FLAGS_baseline "")
set(FLAGS_avx2 -mavx2 -mfma)
set(FLAGS_avx512 -mavx512f -mavx512dq -mavx512vl -mavx512bw -mfma -mbmi2)

# OBJECTS: those of one source of every set.
macro(gsparc_objects name source)
  set(OBJECTS)
  foreach(isa baseline avx2 avx512)
    if(isa STREQUAL baseline OR GSPARC_X86)
      add_library(${name}_${isa} OBJECT ${source})
      target_compile_definitions(${name}_${isa} PRIVATE GSPARC_ISA=${isa})
      target_compile_options(${name}_${isa} PRIVATE ${EXACT} ${FLAGS_${isa}})
      list(APPEND OBJECTS $<TARGET_OBJECTS:${name}_${isa}>)
    endif()
  endforeach()
endmacro()
