# What the client needs, as the targets tactomo::zmq and tactomo::msgpack. Found by their headers,
# because their packages are called otherwise in every distribution and version.
find_path(TACTOMO_ZMQ_INCLUDE zmq.hpp DOC "Folder of cppzmq's zmq.hpp")
find_library(TACTOMO_ZMQ_LIBRARY zmq DOC "libzmq")
find_path(TACTOMO_MSGPACK_INCLUDE msgpack.hpp DOC "Folder of msgpack's msgpack.hpp")

if(NOT TACTOMO_ZMQ_INCLUDE OR NOT TACTOMO_ZMQ_LIBRARY OR NOT TACTOMO_MSGPACK_INCLUDE)
  set(tactomo_missing "tactomo needs zmq.hpp, libzmq and msgpack.hpp, and found \
${TACTOMO_ZMQ_INCLUDE}, ${TACTOMO_ZMQ_LIBRARY}, ${TACTOMO_MSGPACK_INCLUDE}. On Debian and Ubuntu: \
apt install cppzmq-dev libmsgpack-dev. Elsewhere name their prefix: -DCMAKE_PREFIX_PATH=...")
  if(NOT CMAKE_FIND_PACKAGE_NAME)
    message(FATAL_ERROR "${tactomo_missing}")
  endif()
  set(${CMAKE_FIND_PACKAGE_NAME}_FOUND FALSE)
  set(${CMAKE_FIND_PACKAGE_NAME}_NOT_FOUND_MESSAGE "${tactomo_missing}")
  return()
endif()

if(NOT TARGET tactomo::zmq)
  add_library(tactomo::zmq INTERFACE IMPORTED GLOBAL)
  target_include_directories(tactomo::zmq INTERFACE ${TACTOMO_ZMQ_INCLUDE})
  target_link_libraries(tactomo::zmq INTERFACE ${TACTOMO_ZMQ_LIBRARY})
  add_library(tactomo::msgpack INTERFACE IMPORTED GLOBAL)
  target_include_directories(tactomo::msgpack INTERFACE ${TACTOMO_MSGPACK_INCLUDE})
endif()
